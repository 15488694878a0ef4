"""Boundary states over the poses of the experiments, checked by forward kinematics; the choice; what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngrasp.errors import GraspRefused, InvalidProblem, OutOfReach
from dyngrasp.models.robot import read_robot
from dyngrasp.planning.grasp_targets import check_grasp, grasp_targets, ranked_grasp_targets
from dyngrasp.planning.grasp_task import GraspTask, TaskSettings

# Positions over which the paper draws its objects (m), at any yaw.
poses = st.tuples(st.floats(0.6, 0.7), st.floats(-0.1, 0.1), st.floats(-np.pi, np.pi))

ROUNDING = 1e-9  # m, rad, m/s: of the closed form and of a least-squares solution


def standing(task, x: float, y: float, yaw: float) -> pin.SE3:
    return pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, task.grasp_object.rest_height]))


def hand(task, q, q_h) -> pin.SE3:
    """The grasp frame as the hand holds it, in the world, from the axes of the hand's own description."""
    gripper = task.gripper
    T_world_hand = task.robot.forward_kinematics(q) * gripper.T_flange_hand
    z, y = -gripper.approach_axis, gripper.closing_axis
    G = gripper.pad_centres(q_h).mean(axis=0)
    return T_world_hand * pin.SE3(np.column_stack([np.cross(y, z), y, z]), G)


def travel_time(task, q_start, q) -> float:
    speed = task.robot.limits.velocity
    return float((np.abs(q - q_start) / speed).max() + (np.abs(task.place - q) / speed).max())


@settings(max_examples=40, derandomize=True)
@given(poses)
def test_boundary_states_by_forward_kinematics(task, q_start, pose):
    T = standing(task, *pose)
    targets = grasp_targets(T, task, q_start)
    gripper, limits, chosen = task.gripper, task.robot.limits, task.settings
    T_grasp = T * targets.grasp.T_object_grasp

    before = T_grasp.actInv(hand(task, targets.pregrasp.position, targets.gripper_open))
    np.testing.assert_allclose(before.translation, [0, 0, chosen.pregrasp_distance], atol=ROUNDING)
    np.testing.assert_allclose(before.rotation, np.eye(3), atol=ROUNDING)
    at = T_grasp.actInv(hand(task, targets.grasped.position, targets.gripper_closed))
    np.testing.assert_allclose(at.homogeneous, np.eye(4), atol=ROUNDING)

    np.testing.assert_array_equal(targets.gripper_open, gripper.open_posture)
    gap = gripper.aperture(targets.gripper_closed)
    assert gap == pytest.approx(targets.grasp.width - chosen.over_close, abs=1e-9)

    for state, linear in (
        (targets.pregrasp, -chosen.approach_speed * T_grasp.rotation[:, 2]),
        (targets.grasped, np.array([0.0, 0.0, chosen.lift_speed])),
    ):
        J = task.robot.jacobian(state.position)
        # No angular velocity: the flange, G and every other point of the hand move alike.
        np.testing.assert_allclose(J @ state.velocity, [*linear, 0, 0, 0], atol=ROUNDING)
        assert (np.abs(state.velocity) < limits.velocity).all()
        assert (state.position >= limits.position_lower).all()
        assert (state.position <= limits.position_upper).all()
        swivel = state.velocity - np.linalg.pinv(J) @ [*linear, 0, 0, 0]
        np.testing.assert_allclose(J @ swivel, 0, atol=ROUNDING)
        assert np.abs(swivel / limits.velocity).max() >= chosen.swivel_speed_ratio * (1 - 1e-6)
        rate = np.linalg.norm(swivel) / np.linalg.norm(task.kinematics.null_space_rate(state.position))
        assert rate >= chosen.swivel_rate * (1 - 1e-6)
    assert (targets.grasped.position >= limits.position_lower + chosen.limit_margin).all()
    assert (targets.grasped.position <= limits.position_upper - chosen.limit_margin).all()
    singular = np.linalg.svd(task.robot.jacobian(targets.grasped.position), compute_uv=False)[-1]
    assert singular >= chosen.dexterity_min
    np.testing.assert_array_equal(targets.place.position, task.place)
    np.testing.assert_array_equal(targets.place.velocity, 0.0)


@settings(max_examples=25, derandomize=True)
@given(poses)
def test_the_arm_swivels_on_through_the_grasp(task, q_start, pose):
    """Both ends turn the elbow the same way, and the pre-grasp lies behind by about what the turn covers."""
    targets = grasp_targets(standing(task, *pose), task, q_start)
    rates = []
    for state in (targets.pregrasp, targets.grasped):
        J = task.robot.jacobian(state.position)
        swivel = state.velocity - np.linalg.pinv(J) @ (J @ state.velocity)
        rates.append(swivel @ task.kinematics.null_space_rate(state.position))
    assert rates[0] * rates[1] > 0
    turned = (targets.grasped.position - targets.pregrasp.position) @ task.kinematics.null_space_rate(
        targets.grasped.position
    )
    assert turned * rates[1] > 0


@settings(max_examples=8, derandomize=True)
@given(poses)
def test_the_first_is_the_fastest_of_all_and_the_others_follow(task, q_start, pose):
    T = standing(task, *pose)
    ranked = list(ranked_grasp_targets(T, task, q_start))
    times = [travel_time(task, q_start, targets.grasped.position) for targets in ranked]
    assert times == sorted(times)
    limits, margin = task.robot.limits, task.settings.limit_margin
    admissible = []
    for grasp in task.grasp_object.grasps:
        closed = hand(task, np.zeros(7), task.closed_posture(grasp))
        T_flange_grasp = task.robot.forward_kinematics(np.zeros(7)).actInv(closed)
        for q in task.kinematics.solutions(T * grasp.T_object_grasp * T_flange_grasp.inverse()):
            inside = (q >= limits.position_lower + margin) & (q <= limits.position_upper - margin)
            singular = np.linalg.svd(task.robot.jacobian(q), compute_uv=False)[-1]
            if inside.all() and singular >= task.settings.dexterity_min:
                admissible.append(travel_time(task, q_start, q))
    assert times[0] == pytest.approx(min(admissible), abs=1e-9)
    postures = [targets.grasped.position for targets in ranked]
    for i, q in enumerate(postures):
        assert all(np.abs(q - other).max() >= 0.5 for other in postures[:i])
    np.testing.assert_array_equal(grasp_targets(T, task, q_start).grasped.position, postures[0])


def test_start_decides_the_choice(task, T_world_object, q_start):
    """From the second-best posture itself, nothing is nearer."""
    ranked = list(ranked_grasp_targets(T_world_object, task, q_start))
    assert len(ranked) >= 2
    other = ranked[-1].grasped.position
    at_place = replace(task, place=other)
    again = grasp_targets(T_world_object, at_place, other)
    assert np.abs(again.grasped.position - other).max() < 0.1


def test_a_grip_that_is_too_wide_is_refused(task, T_world_object, q_start):
    opening = task.gripper.aperture(task.gripper.open_posture)
    limit = opening - 2 * task.settings.side_clearance_min
    for width, refused in ((limit - 1e-5, False), (limit + 1e-5, True)):
        wide = replace(task.grasp_object.grasps[0], width=width)
        one = replace(task, grasp_object=replace(task.grasp_object, grasps=(wide,)))
        if refused:
            with pytest.raises(GraspRefused, match=f"opens {opening * 1e3:.1f} mm.*{width * 1e3:.1f} mm wide"):
                grasp_targets(T_world_object, one, q_start)
        else:
            grasp_targets(T_world_object, one, q_start)


def pressing(task) -> float:
    """Force of each pad (N)."""
    return task.settings.grip_share * task.gripper.pinch_force


def test_a_part_that_would_turn_in_the_hand_is_refused(task, T_world_object):
    part, grasp = task.grasp_object, task.grasp_object.grasps[0]
    offset = abs(part.centre_of_mass[0] - grasp.T_object_grasp.translation[0])
    moment = part.mass * 9.81 * offset
    limit = task.settings.holding_safety * moment / (2 * pressing(task))
    for factor in (0.99, 1.01):
        changed = replace(part, friction=replace(part.friction, torsional=factor * limit))
        one = replace(task, grasp_object=changed)
        if factor < 1:
            with pytest.raises(GraspRefused, match=f"torsion.*{moment:.3f} Nm"):
                check_grasp(grasp, T_world_object, one)
        else:
            check_grasp(grasp, T_world_object, one)


def test_a_part_that_is_too_heavy_is_refused(task, T_world_object):
    part, grasp = task.grasp_object, task.grasp_object.grasps[0]
    weight = 2 * part.friction.sliding * pressing(task) / task.settings.holding_safety
    # Below the pinch axis, so that nothing but the weight is too much.
    hanging = replace(part, centre_of_mass=np.array([0.0, 0.0, part.centre_of_mass[2]]))
    for factor in (0.99, 1.01):
        mass = factor * weight / 9.81
        one = replace(task, grasp_object=replace(hanging, mass=mass))
        if factor > 1:
            with pytest.raises(GraspRefused, match=f"weighs {mass * 9.81:.1f} N"):
                check_grasp(grasp, T_world_object, one)
        else:
            check_grasp(grasp, T_world_object, one)


def test_one_refused_grasp_leaves_the_other(task, T_world_object, q_start):
    first, second = task.grasp_object.grasps
    part = replace(task.grasp_object, grasps=(replace(first, width=0.2), second))
    assert grasp_targets(T_world_object, replace(task, grasp_object=part), q_start).grasp is second


@pytest.mark.parametrize("x", [1.0, 1.3])
def test_out_of_reach_says_by_how_much(task, q_start, x):
    """Farther by 0.3 m is farther by 0.3 m at the wrist, too, up to the slope of the line from the shoulder."""
    with pytest.raises(OutOfReach) as far:
        grasp_targets(standing(task, x, 0.0, 0.4), task, q_start)
    with pytest.raises(OutOfReach) as farther:
        grasp_targets(standing(task, x + 0.3, 0.0, 0.4), task, q_start)
    assert far.value.distance > 0
    assert farther.value.distance - far.value.distance == pytest.approx(0.3, abs=0.02)
    assert f"{far.value.distance:.3g} m" in str(far.value)


@pytest.mark.parametrize("changes", [{"dexterity_min": 10.0}, {"limit_margin": 2.0}])
def test_no_posture_that_keeps_clear(task, T_world_object, q_start, changes):
    strict = replace(task, settings=replace(task.settings, **changes))
    with pytest.raises(OutOfReach, match=r"'rib' of casting.*no posture keeps \d+° from the joint limits"):
        grasp_targets(T_world_object, strict, q_start)


def six_joint_arm(folder: Path) -> Path:
    """An elbow arm with a spherical wrist, 0.42 m and 0.4 m long like the iiwa, but without its third joint."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    heights = (0.1, 0.26, 0.42, 0.2, 0.2, 0.126)
    links = "".join(
        f"<body pos='0 0 {height}'><joint name='J{i + 1}' axis='{axis}' range='-3 3'/>"
        "<inertial pos='0 0 0.05' mass='2' diaginertia='0.01 0.01 0.01'/>"
        for i, (axis, height) in enumerate(zip(axes, heights, strict=True))
    )
    xml = f"<compiler angle='radian'/><worldbody>{links}<site name='tip'/>{'</body>' * 6}</worldbody>"
    (folder / "arm.xml").write_text(f"<mujoco>{xml}</mujoco>")
    (folder / "model.toml").write_text(
        "kind = 'robot'\nname = 'six'\nmjcf = 'arm.xml'\ntip_frame = 'tip'\n[limits]\n"
        f"position_lower_deg = {[-170.0] * 6}\nposition_upper_deg = {[170.0] * 6}\n"
        f"velocity_deg_per_s = {[90.0] * 6}\ntorque_nm = {[200.0] * 6}\n"
    )
    return folder / "model.toml"


def test_an_arm_without_a_null_space_does_not_swivel(task, T_world_object, tmp_path):
    arm = read_robot(six_joint_arm(tmp_path))
    six = GraspTask(arm, task.gripper, task.grasp_object, np.zeros(6), task.settings)
    targets = grasp_targets(T_world_object, six, np.zeros(6))
    z = targets.T_world_grasp.rotation[:, 2]
    for state, linear in (
        (targets.pregrasp, -task.settings.approach_speed * z),
        (targets.grasped, np.array([0.0, 0.0, task.settings.lift_speed])),
    ):
        J = arm.jacobian(state.position)
        np.testing.assert_allclose(J @ state.velocity, [*linear, 0, 0, 0], atol=1e-8)
        np.testing.assert_allclose(state.velocity, np.linalg.solve(J, [*linear, 0, 0, 0]), atol=1e-8)
    at = targets.T_world_grasp.actInv(hand(six, targets.grasped.position, targets.gripper_closed))
    np.testing.assert_allclose(at.homogeneous, np.eye(4), atol=1e-9)


def test_loads_follow_from_hand_and_part(task):
    """What the flange carries weighs as much as hand and part, and turns about their common centre of mass."""
    hand_mass = task.gripper.inertia(task.gripper.open_posture).mass
    assert task.robot_empty.payload.mass == pytest.approx(hand_mass)
    for grasp in task.grasp_object.grasps:
        loaded = task.robot_loaded(grasp)
        assert loaded.payload.mass == pytest.approx(hand_mass + task.grasp_object.mass)
        assert loaded is task.robot_loaded(grasp)
        closed = task.closed_posture(grasp)
        T_flange_grasp = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(closed)
        com = T_flange_grasp.act(grasp.T_object_grasp.actInv(np.array(task.grasp_object.centre_of_mass)))
        own = task.gripper.payload(closed)
        lever = (own.mass * own.lever + task.grasp_object.mass * com) / loaded.payload.mass
        np.testing.assert_allclose(loaded.payload.lever, lever, atol=1e-12)


@pytest.mark.parametrize(
    "bad",
    [
        {"lift_speed": -0.01},
        {"approach_speed": np.nan},
        {"pregrasp_distance": 0.0},
        {"grip_share": 1.2},
        {"grasp_duration_min": 0.9, "grasp_duration_max": 0.8},
    ],
)
def test_senseless_settings_are_refused(bad):
    with pytest.raises(InvalidProblem, match=next(iter(bad))):
        TaskSettings(**bad)
