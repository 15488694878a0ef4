"""Updated targets against forward kinematics, and that the posture follows the part without a jump."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngrasp.errors import OutOfReach
from dyngrasp.models.inverse_kinematics import joint_velocity
from dyngrasp.models.srs_kinematics import SrsKinematics
from dyngrasp.planning.grasp_targets import moved, swivel_velocity
from dyngrasp.planning.replanning.target_update import TargetUpdater, updated_targets

MOVES = {"x": st.floats(-0.04, 0.04), "y": st.floats(-0.04, 0.04), "turn": st.floats(-0.3, 0.3)}


def displaced(T, x, y, turn):
    return pin.SE3(pin.utils.rotate("z", turn) @ T.rotation, T.translation + np.array([x, y, 0.0]))


def grasp_frame(task, q, posture):
    gripper = task.gripper
    return task.robot.forward_kinematics(q) * gripper.T_flange_hand * gripper.T_hand_grasp(posture)


@settings(max_examples=40)
@given(**MOVES)
def test_hand_comes_to_the_new_pose_by_the_same_branch_and_arm_angle(task, targets, x, y, turn):
    T = displaced(targets.T_world_object, x, y, turn)
    new = updated_targets(targets, T, task)
    above = pin.SE3(np.eye(3), np.array([0.0, 0.0, task.settings.pregrasp_distance]))
    T_grasp = T * targets.grasp.T_object_grasp
    kinematics = SrsKinematics.from_robot(task.robot)
    for old, state, wanted, posture in (
        (targets.grasped, new.grasped, T_grasp, targets.gripper_closed),
        (targets.pregrasp, new.pregrasp, T_grasp * above, targets.gripper_open),
    ):
        # closed form: rounding of some turns of trigonometry
        assert np.abs(pin.log6(wanted.actInv(grasp_frame(task, state.position, posture))).vector).max() < 1e-9
        assert kinematics.branch(state.position) == kinematics.branch(old.position)
        assert abs(kinematics.arm_angle(state.position) - kinematics.arm_angle(old.position)) < 1e-9


@settings(max_examples=25)
@given(**MOVES)
def test_small_moves_of_the_part_are_small_moves_of_the_arm(task, targets, x, y, turn):
    T = targets.T_world_object
    previous = targets
    for share in (0.25, 0.5, 0.75, 1.0):
        new = updated_targets(previous, displaced(T, share * x, share * y, share * turn), task)
        step = np.hypot(x, y) / 4 / 0.15 + abs(turn) / 4 + 1e-9
        # 0.15 m: no joint of this arm at this posture has a shorter lever; the factor is its dexterity
        assert np.abs(new.grasped.position - previous.grasped.position).max() < 3 * step
        assert np.abs(new.grasped.velocity - previous.grasped.velocity).max() < 0.5 * (step + 1e-6)
        previous = new


def test_the_same_pose_gives_the_same_targets(task, targets):
    new = updated_targets(targets, targets.T_world_object, task)
    for a, b in ((new.pregrasp, targets.pregrasp), (new.grasped, targets.grasped)):
        assert np.abs(a.position - b.position).max() < 1e-9
        assert np.abs(a.velocity - b.velocity).max() < 1e-8
    assert new.place is targets.place


@pytest.mark.parametrize("turn", [0.0, -0.48])
def test_hand_moves_with_a_moving_part_and_lifts(task, targets, turn):
    # Turned so far the limits forbid the arm angle of the plan at the pre-grasp.
    twist = np.array([0.05, -0.03, 0.0, 0.0, 0.0, 0.2])
    duration = 0.6
    new = TargetUpdater(task).update(targets, displaced(targets.T_world_object, 0.0, 0.0, turn), twist, 3.0, duration)
    kinematics = SrsKinematics.from_robot(task.robot)
    kept = [
        abs(kinematics.arm_angle(b.position) - kinematics.arm_angle(a.position)) < 1e-9
        for a, b in ((targets.pregrasp, new.pregrasp), (targets.grasped, new.grasped))
    ]
    assert all(kept) == (turn == 0.0)
    robot, settings_ = task.robot, task.settings
    T = new.T_world_object
    for state, when, own in (
        (new.grasped, 0.0, np.array([0.0, 0.0, settings_.lift_speed])),
        (
            new.pregrasp,
            -duration,
            -settings_.approach_speed * (moved(T, twist, -duration) * targets.grasp.T_object_grasp).rotation[:, 2],
        ),
    ):
        flange = robot.forward_kinematics(state.position)
        velocity = robot.jacobian(state.position) @ state.velocity
        part = moved(T, twist, when)
        like = targets.grasped if state is new.grasped else targets.pregrasp
        swing = state.velocity - joint_velocity(robot, state.position, robot.jacobian(state.position) @ state.velocity)
        wanted = swivel_velocity(state.position, state.position, task, like=like.velocity)
        np.testing.assert_allclose(swing, wanted, rtol=0.0, atol=1e-12)
        carried = twist[:3] + np.cross(twist[3:], flange.translation - part.translation)
        assert np.abs(velocity[:3] - carried - own).max() < 1e-9
        assert np.abs(velocity[3:] - twist[3:]).max() < 1e-9
    before = new.T_world_object_at(3.0 - duration) * targets.grasp.T_object_grasp
    above = pin.SE3(np.eye(3), np.array([0.0, 0.0, settings_.pregrasp_distance]))
    hand = grasp_frame(task, new.pregrasp.position, targets.gripper_open)
    assert np.abs(pin.log6((before * above).actInv(hand)).vector).max() < 1e-9


def test_out_of_reach_is_refused(task, targets):
    with pytest.raises(OutOfReach):
        updated_targets(targets, displaced(targets.T_world_object, 1.0, 0.0, 0.0), task)


def test_where_the_arm_angle_of_the_plan_is_forbidden_the_nearest_of_the_branch_is_taken(task, targets):
    kinematics = SrsKinematics.from_robot(task.robot)
    updater, like = TargetUpdater(task), targets.grasped.position
    pose, branch, angle = task.robot.forward_kinematics(like), kinematics.branch(like), kinematics.arm_angle(like)
    turned = 0
    for turn in np.deg2rad(np.arange(5.0, 120.0, 5.0)):
        T = pose * pin.SE3(pin.utils.rotate("z", turn), np.zeros(3))
        both = np.array([pose.homogeneous[:3], T.homogeneous[:3]])
        try:
            found = updater.postures(both, np.array([like, like]))
        except OutOfReach:
            continue
        np.testing.assert_allclose(found[0], like, rtol=0.0, atol=1e-9)
        assert np.abs(pin.log6(T.actInv(task.robot.forward_kinematics(found[1]))).vector).max() < 1e-9
        assert kinematics.branch(found[1]) == branch
        steps = np.rint(np.rad2deg(kinematics.arm_angle(found[1]) - angle) / 2.0)
        assert abs(kinematics.arm_angle(found[1]) - angle - np.deg2rad(2.0 * steps)) < 1e-9
        for step in np.arange(-abs(steps) + 1, abs(steps)):
            with pytest.raises(OutOfReach):
                kinematics.solve(T, angle + np.deg2rad(2.0 * step), branch)
        turned += steps != 0
    assert turned > 0
    flipped = pose * pin.SE3(pin.utils.rotate("z", np.pi), np.zeros(3))
    with pytest.raises(OutOfReach, match=r"no arm angle|turn by"):
        updater.postures(flipped.homogeneous[None, :3], like[None])


@settings(max_examples=10)
@given(**MOVES)
def test_an_arm_without_a_closed_form_follows_too(task, targets, x, y, turn):
    general = replace(task, robot=replace(task.robot, kinematics="general", srs=None))
    T, twist, duration = displaced(targets.T_world_object, x, y, turn), np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.1]), 0.6
    new = TargetUpdater(general).update(targets, T, twist, 3.0, duration)
    exact = TargetUpdater(task).update(targets, T, twist, 3.0, duration)
    robot = task.robot
    for state, other in ((new.grasped, exact.grasped), (new.pregrasp, exact.pregrasp)):
        between = robot.forward_kinematics(other.position).actInv(robot.forward_kinematics(state.position))
        # tolerance of the numerical solution: 1e-10 m and rad
        assert np.abs(pin.log6(between).vector).max() < 1e-9
        velocities = robot.jacobian(state.position) @ state.velocity, robot.jacobian(other.position) @ other.velocity
        assert np.abs(velocities[0] - velocities[1]).max() < 1e-8
