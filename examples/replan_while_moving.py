"""Replace the trajectory while the arm moves: the part turns out to be two centimetres from where it was believed."""

import numpy as np
import pinocchio as pin

import dyngrasp as dg

q_start = np.deg2rad([55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0])
q_place = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])
task = dg.GraspTask(dg.load_robot("iiwa14"), dg.load_gripper("sdh2"), dg.load_object("casting"), place=q_place)

believed = pin.SE3(np.eye(3), np.array([0.65, 0.0, task.grasp_object.rest_height]))
targets = dg.grasp_targets(believed, task, q_start)
plan = dg.CollocationPlanner(task).plan(q_start, targets).require()

# A better estimate arrives 1.2 s into the motion. The new plan keeps the posture of the arm and takes over 20 ms later.
# The first call of a process loads compiled code, which no deadline survives: one call beforehand takes care of that.
seen = pin.SE3(np.eye(3), np.array([0.66, 0.018, task.grasp_object.rest_height]))
replanner = dg.Replanner(task)
replanner.replan(plan, targets, t=1.0)
result = replanner.replan(plan, dg.updated_targets(targets, seen, task), t=1.2)

print(f"{result.status} by {result.path} in {result.timings_ms['total']:.1f} ms; {result.message or 'audit passed'}")
before, after = plan.sample(result.splice), result.plan.sample(result.splice)
for name in ("position", "velocity", "acceleration"):
    jump = np.abs(getattr(before.arm, name) - getattr(after.arm, name)).max()
    print(f"jump of the {name} at the splice, {result.splice:.3f} s: {jump:.1e}")
G = task.robot.forward_kinematics(result.plan.arm[1].position[-1]) * task.T_flange_closed(targets.grasp)
print(f"the hand closes at {G.translation.round(4).tolist()} m, {result.plan.phase_ends[1]:.2f} s")
