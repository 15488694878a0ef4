"""Worst values of a plan's samples against Pinocchio, called for one sample after the other."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.planning.audit import audit
from dyngrasp.planning.plan_samples import SUBSTEPS
from dyngrasp.trajectory import Trajectory

from .failing_cases import PLANS, arm_limited, every_other, unchecked, with_arm


def busier_pad(wrench: pin.Force, task, grasp) -> float:
    """Friction that the two pads need over what they have, by the statics of two contacts at y = ±w/2."""
    friction, N = task.grasp_object.friction, task.settings.grip_share * task.gripper.pinch_force
    arm = np.array([0.0, grasp.width / 2, 0.0])
    shares = []
    for side in (1, -1):
        # Half of the force each, and the couple whose moment about x and z is the wrench's.
        couple = np.cross(wrench.angular * [1, 0, 1], side * arm) / (2 * arm @ arm)
        tangential = wrench.linear * [1, 0, 1] / 2 + couple
        normal = N - side * wrench.linear[1] / 2
        load = np.hypot(np.linalg.norm(tangential) / friction.sliding, wrench.angular[1] / 2 / friction.torsional)
        shares.append(load / normal)
    return max(shares)


def one_sample_after_the_other(plan, targets, task, substeps: int) -> dict[str, float]:
    """Worst values by Pinocchio, called for each sample by itself, on a grid `substeps` times as fine as the plan's."""
    robots = (task.robot_empty, task.robot_empty, task.robot_loaded(targets.grasp))
    torque, h, lateral, dip, angle, share = [], [], [], [], [], []
    part, gripper, model = task.grasp_object, task.gripper, task.robot.pin_model
    data, tip = model.createData(), task.robot.tip_id
    T_flange_closed = gripper.T_flange_hand * gripper.T_hand_grasp(targets.gripper_closed)
    part_in_grasp = targets.grasp.T_object_grasp.inverse().act(part.spatial_inertia)
    for phase, (arm, fingers, robot) in enumerate(zip(plan.arm, plan.gripper, robots, strict=True)):
        for t in np.linspace(0.0, arm.duration, substeps * arm.intervals + 1):
            state, q_h = arm.sample(t), fingers.sample(t).position
            q, w, v = state.position, state.velocity, state.acceleration
            torque.append(np.abs(robot.inverse_dynamics(q, w, v) / robot.limits.torque).max())
            hand = robot.forward_kinematics(q) * gripper.T_flange_hand * gripper.T_hand_grasp(q_h)
            x, y, z = targets.T_world_grasp.actInv(hand.translation)
            if phase == 0:
                f = part.funnel
                h.append(z - f.z_threshold * (1 - np.exp(-0.5 * ((x / f.sigma_x) ** 2 + (y / f.sigma_y) ** 2))))
            elif phase == 1:
                lateral.append(np.hypot(x, y))
                dip.append(z)
                angle.append(np.linalg.norm(pin.log3(targets.T_world_grasp.rotation.T @ hand.rotation)))
            else:
                pin.forwardKinematics(model, data, q, w, v)
                pin.updateFramePlacement(model, data, tip)
                velocity = T_flange_closed.actInv(pin.getFrameVelocity(model, data, tip, pin.LOCAL))
                acceleration = T_flange_closed.actInv(pin.getFrameAcceleration(model, data, tip, pin.LOCAL))
                upward = (data.oMf[tip] * T_flange_closed).rotation.T @ -model.gravity.linear
                acceleration.linear = acceleration.linear + upward
                wrench = part_in_grasp * acceleration + velocity.cross(part_in_grasp * velocity)
                share.append(busier_pad(wrench, task, targets.grasp))
    return {
        "torque": max(torque),
        "funnel": min(h),
        "grasp_axis": max(lateral),
        "grasp_dip": min(dip),
        "grasp_tilt": max(angle),
        "hold": max(share),
    }


def test_worst_values_are_those_of_one_sample_after_the_other(plan, targets, task):
    """Of the grid points, or of samples between them where a constraint could be worse."""
    report = audit(plan, targets, task)
    at_grid_points, finer = (one_sample_after_the_other(plan, targets, task, n) for n in (1, SUBSTEPS))
    for name, value in at_grid_points.items():
        # Rounding of kinematics and dynamics; the funnel's wall climbs up to 30 m per metre.
        nearest = min(value, finer[name], key=lambda x, of=report[name].worst: abs(x - of))
        assert report[name].worst == pytest.approx(nearest, abs=1e-11), name
    # The last acceleration of the approach is free and off the line of those before, and the wall is steep there.
    assert report["funnel"].worst == pytest.approx(finer["funnel"], abs=1e-11)
    assert finer["funnel"] < at_grid_points["funnel"] - 1e-4


@pytest.mark.parametrize(
    ("name", "key"),
    [("grasp_axis", "lateral_tolerance"), ("grasp_dip", "dip_tolerance"), ("grasp_tilt", "tilt_tolerance")],
)
def test_what_is_broken_between_two_grid_points_only_is_found(plan, targets, task, name, key):
    """The hand goes aside half way through the grasp, between two points of a coarse grid; the limit lies between."""
    aside = PLANS[name](plan, task)
    coarse = with_arm(aside, *(every_other(phase, 20) for phase in aside.arm))
    coarse = unchecked(coarse, gripper=tuple(every_other(phase, 20) for phase in aside.gripper))
    grid, inside = (one_sample_after_the_other(coarse, targets, task, substeps)[name] for substeps in (1, SUBSTEPS))
    assert abs(inside) > 1.1 * abs(grid), "no peak between the grid points"
    strict = replace(task, settings=replace(task.settings, **{key: abs(grid + inside) / 2}))
    entry = audit(coarse, targets, strict)[name]
    assert not entry.ok
    assert entry.worst == pytest.approx(inside, abs=1e-11)


def ringing(plan, phase: int, joint: int, amount: float):
    """The plan with an acceleration that jumps to and fro, of which grid points show no position and no velocity."""
    whole = plan.arm[phase]
    v = whole.acceleration.copy()
    v[::2, joint] += amount
    v[1::2, joint] -= amount
    rung = Trajectory(whole.duration, whole.position, whole.velocity, v)
    return with_arm(plan, *(rung if i == phase else other for i, other in enumerate(plan.arm)))


def test_a_velocity_that_rings_between_grid_points_is_found(plan, targets, task):
    """The trapezoidal rule allows it: neighbouring accelerations cancel."""
    joint, arm, limits = 3, plan.arm[0], task.robot.limits
    step, fastest = arm.duration / arm.intervals, np.abs(arm.velocity[:, joint]).max()
    velocity = limits.velocity.copy()
    velocity[joint] = 1.001 * fastest
    strict = arm_limited(task, None, velocity=velocity)
    assert audit(plan, targets, strict)["velocity"].ok
    # Half way the velocity departs by Δt/4 times the amplitude.
    bad = ringing(plan, 0, joint, 4 * 0.02 * fastest / step)
    entry = audit(bad, targets, strict)["velocity"]
    assert not entry.ok
    times = np.linspace(0.0, arm.duration, SUBSTEPS * arm.intervals + 1)
    found = np.abs(bad.arm[0].sample_many(times)[1][:, joint]).max() / velocity[joint]
    assert found > 1.015
    assert entry.worst == pytest.approx(found, abs=1e-12)


def test_a_position_that_rings_between_grid_points_is_found(plan, targets, task):
    joint, limits = 3, task.robot.limits
    coarse = with_arm(plan, *(every_other(phase, 20) for phase in plan.arm))
    coarse = unchecked(coarse, gripper=tuple(every_other(phase, 20) for phase in plan.gripper))
    grid = max(phase.position[:, joint].max() for phase in coarse.arm)
    bad = ringing(coarse, 0, joint, 30.0)
    times = np.linspace(0.0, bad.arm[0].duration, SUBSTEPS * bad.arm[0].intervals + 1)
    found = bad.arm[0].sample_many(times)[0][:, joint].max()
    assert found > grid + 0.05, "nothing rings"
    upper = limits.position_upper.copy()
    upper[joint] = (grid + found) / 2
    strict = arm_limited(task, None, position_upper=upper)
    assert not audit(bad, targets, strict)["position"].ok


def test_a_hand_that_rings_between_grid_points_is_found(plan, targets, task):
    """At them it stays inside the funnel."""
    bad = ringing(plan, 0, 0, 20.0)
    grid, inside = (one_sample_after_the_other(bad, targets, task, n)["funnel"] for n in (1, SUBSTEPS))
    assert grid > 0.001
    assert inside < -0.0005
    entry = audit(bad, targets, task)["funnel"]
    assert not entry.ok
    assert entry.worst == pytest.approx(inside, abs=1e-11)
