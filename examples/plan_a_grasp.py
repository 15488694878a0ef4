"""Plan a dynamic grasp: approach, grasp and delivery for arm and hand on one timeline."""

import numpy as np
import pinocchio as pin

import dyngrasp as dg

q_start = np.deg2rad([55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0])  # the paper's q_S
q_place = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])  # hand upright, to the right front

task = dg.GraspTask(dg.load_robot("iiwa14"), dg.load_gripper("sdh2"), dg.load_object("casting"), place=q_place)

# The part stands on the ground, turned by 20 degrees.
turn = np.deg2rad(20.0)
rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
T_world_object = pin.SE3(rotation, np.array([0.65, 0.05, task.grasp_object.rest_height]))

targets = dg.grasp_targets(T_world_object, task, q_start)
result = dg.CollocationPlanner(task).plan(q_start, targets)
plan = result.require()

print(f"grasp {targets.grasp.name!r}; phases {plan.durations.round(2).tolist()} s")
for entry in result.audit.entries if result.audit else ():
    print(f"  {entry}")

state = plan.sample(plan.phase_ends[0])
fastest = np.abs(state.arm.velocity).max()
print(f"at {state.arm.t:.2f} s the grasp begins, and the fastest joint turns with {fastest:.3f} rad/s: nothing stops")
