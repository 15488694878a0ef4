"""Closed form of the S-R-S arm against forward kinematics, geometry and brute force."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dyngrasp.errors import InvalidProblem, ModelFileError, OutOfReach
from dyngrasp.models.catalogue import load_robot
from dyngrasp.models.robot import SrsLengths
from dyngrasp.models.srs_kinematics import SrsKinematics

ROBOT = load_robot("iiwa14")
ARM = SrsKinematics.from_robot(ROBOT)
LOWER, UPPER = ROBOT.limits.position_lower, ROBOT.limits.position_upper
# Every angle is within these limits.
WIDE = SrsKinematics(
    ARM.lengths, replace(ROBOT.limits, position_lower=np.full(7, -3.2), position_upper=np.full(7, 3.2))
)
UPPER_ARM, FOREARM = 0.420, 0.400

# Rounding of 1e-16 m, magnified by the product of two sines of at least 1e-3.
EXACT = 1e-10


def pose_difference(a: pin.SE3, b: pin.SE3) -> float:
    return float(np.abs(a.homogeneous - b.homogeneous).max())


def angle_difference(a: float, b: float) -> float:
    return abs(math.remainder(a - b, 2.0 * math.pi))


def shoulder_elbow_wrist(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The three centres, from the frames of the description instead of the closed form."""
    data = ROBOT.pin_model.createData()
    pin.forwardKinematics(ROBOT.pin_model, data, q)
    shoulder = np.array([0.0, 0.0, 0.360])
    flange = ROBOT.forward_kinematics(q)
    return shoulder, shoulder + UPPER_ARM * data.oMi[3].rotation[:, 2], flange.act(np.array([0.0, 0.0, -0.126]))


def far_from_singular(q: np.ndarray, margin: float) -> bool:
    shoulder, _, wrist = shoulder_elbow_wrist(q)
    level = np.hypot(*(wrist - shoulder)[:2])
    return min(np.abs(np.sin(q[[1, 3, 5]])).min(), level) > margin


@st.composite
def postures(draw: st.DrawFn) -> np.ndarray:
    fractions = [draw(st.floats(0.0, 1.0)) for _ in range(7)]
    return LOWER + np.array(fractions) * (UPPER - LOWER)


# Angles at which shoulder, elbow or wrist line up, alone and together, among ordinary ones.
@st.composite
def lined_up_postures(draw: st.DrawFn) -> np.ndarray:
    return np.array([draw(st.sampled_from([0.0, 0.5 * math.pi, -0.5 * math.pi, 1.0, -0.3])) for _ in range(7)])


def random_postures(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


def test_inverts_forward_kinematics_at_ten_thousand_postures() -> None:
    worst_angle = worst_pose = 0.0
    compared = 0
    for q in random_postures(10_000, seed=1):
        T = ROBOT.forward_kinematics(q)
        solved = ARM.solve(T, ARM.arm_angle(q), ARM.branch(q))
        worst_pose = max(worst_pose, pose_difference(ROBOT.forward_kinematics(solved), T))
        if far_from_singular(q, 1e-3):
            worst_angle, compared = max(worst_angle, float(np.abs(solved - q).max())), compared + 1
    assert worst_pose < 1e-13
    assert worst_angle < EXACT
    assert compared > 9_900


def test_forward_kinematics_is_that_of_the_description() -> None:
    for q in random_postures(200, seed=2):
        assert pose_difference(ARM.forward_kinematics(q), ROBOT.forward_kinematics(q)) < 1e-14
    assert ARM.forward_kinematics(np.zeros(7)).translation == pytest.approx([0.0, 0.0, 1.306], abs=1e-15)


def test_positive_elbow_angle_turns_the_forearm_backwards() -> None:
    q = np.zeros(7)
    q[3] = 0.5
    assert ARM.forward_kinematics(q).translation[0] < -0.2


def test_arm_angle_is_the_angle_of_the_elbow_about_shoulder_and_wrist() -> None:
    for q in random_postures(500, seed=3):
        if not far_from_singular(q, 1e-2):
            continue
        shoulder, elbow, wrist = shoulder_elbow_wrist(q)
        u = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
        reference = np.array([0.0, 0.0, 1.0]) - u[2] * u
        offset = elbow - shoulder - ((elbow - shoulder) @ u) * u
        angle = math.atan2(np.cross(reference, offset) @ u, reference @ offset)
        assert angle_difference(ARM.arm_angle(q), angle) < 1e-10


def test_elbow_is_highest_at_arm_angle_zero() -> None:
    T = ROBOT.forward_kinematics(np.array([0.4, 0.7, 0.2, -1.4, 0.3, 0.9, 0.0]))
    found = ARM.scan(T)
    heights = [shoulder_elbow_wrist(q)[1][2] for q in found.configurations]
    assert found.arm_angles[int(np.argmax(heights))] == pytest.approx(0.0, abs=1e-12)


@settings(max_examples=200)
@given(postures())
def test_round_trip(q: np.ndarray) -> None:
    assume(far_from_singular(q, 1e-3))
    # Two angles of 1e-3 divide the rounding of about 1e-15 m.
    solved = ARM.solve(ROBOT.forward_kinematics(q), ARM.arm_angle(q), ARM.branch(q))
    assert np.abs(solved - q).max() < 1e-8


@settings(max_examples=60)
@given(postures(), st.integers(1, 40))
def test_scan_finds_admissible_configurations_of_the_pose_and_says_which(q: np.ndarray, count: int) -> None:
    assume(far_from_singular(q, 1e-3))
    T, grid = ROBOT.forward_kinematics(q), np.append(np.linspace(-3.0, 3.0, count), ARM.arm_angle(q))
    found = ARM.scan(T, grid)
    assert np.abs(found.configurations - q).max(axis=1).min() < 1e-8
    assert (found.configurations >= LOWER).all()
    assert (found.configurations <= UPPER).all()
    for solution, psi, branch in zip(found.configurations, found.arm_angles, found.branches, strict=True):
        assert pose_difference(ROBOT.forward_kinematics(solution), T) < 1e-9
        assert np.abs(ARM.solve(T, psi, int(branch)) - solution).max() < 1e-9
        if far_from_singular(solution, 1e-3):
            assert ARM.branch(solution) == branch
            assert angle_difference(ARM.arm_angle(solution), psi) < 1e-8


def test_scan_and_solve_leave_out_exactly_what_the_limits_forbid() -> None:
    T = ROBOT.forward_kinematics(np.array([0.4, 0.7, 0.2, -1.4, 0.3, 0.9, 0.0]))
    everything = WIDE.scan(T)
    assert everything.configurations.shape == (72 * 8, 7)
    kept = ((everything.configurations >= LOWER) & (everything.configurations <= UPPER)).all(axis=1)
    assert 0 < kept.sum() < kept.size
    np.testing.assert_array_equal(ARM.scan(T).configurations, everything.configurations[kept])
    outside = int(np.argmin(kept))
    with pytest.raises(OutOfReach, match=r"joint \d would stand at") as refused:
        ARM.solve(T, everything.arm_angles[outside], int(everything.branches[outside]))
    assert refused.value.distance == 0.0


def test_eight_branches_share_the_elbow() -> None:
    T = ROBOT.forward_kinematics(np.array([0.4, 0.7, 0.2, -1.4, 0.3, 0.9, 0.0]))
    solutions = np.array([WIDE.solve(T, 0.6, branch) for branch in range(8)])
    elbows = np.array([shoulder_elbow_wrist(q)[1] for q in solutions])
    assert np.abs(elbows - elbows[0]).max() < 1e-14
    gaps = np.abs(solutions[:, None] - solutions[None]).max(axis=2) + 10.0 * np.eye(8)
    assert gaps.min() > 0.1
    np.testing.assert_allclose(WIDE.solve(T, 0.6 + 2.0 * math.pi, 5), solutions[5], atol=1e-13)


@settings(max_examples=150)
@given(lined_up_postures())
def test_lined_up_joints_are_solved_without_nan(q: np.ndarray) -> None:
    T = ROBOT.forward_kinematics(q)
    solved = ARM.solve(T, ARM.arm_angle(q), ARM.branch(q))
    assert pose_difference(ROBOT.forward_kinematics(solved), T) < 1e-11
    for solution in ARM.solutions(T, count=12):
        assert pose_difference(ROBOT.forward_kinematics(solution), T) < 1e-11


def test_lined_up_joints_share_their_common_turn() -> None:
    q = np.array([0.8, 0.0, 0.2, -1.0, 0.5, 0.0, 0.1])
    solved = ARM.solve(ROBOT.forward_kinematics(q), ARM.arm_angle(q), ARM.branch(q))
    np.testing.assert_allclose(solved, [0.5, 0.0, 0.5, -1.0, 0.3, 0.0, 0.3], atol=1e-12)


def test_arm_angle_above_the_base_counts_from_the_x_axis() -> None:
    # The wrist stands on the shoulder's axis; q1 turns the elbow about it.
    q2, q4 = math.atan2(FOREARM * math.sin(1.0), UPPER_ARM + FOREARM * math.cos(1.0)), 1.0
    here = ARM.arm_angle([0.0, q2, 0.0, q4, 0.0, 0.7, 0.0])
    assert here == pytest.approx(0.0, abs=1e-9)
    assert ARM.arm_angle([0.9, q2, 0.0, q4, 0.0, 0.7, 0.0]) == pytest.approx(0.9, abs=1e-9)


@pytest.mark.parametrize("excess", [1e-3, 0.25, 3.0])
def test_too_far_says_by_how_much(excess: float) -> None:
    direction = np.array([0.6, 0.0, 0.8])
    tip = np.array([0.0, 0.0, 0.360]) + (UPPER_ARM + FOREARM + excess) * direction + np.array([0.0, 0.0, 0.126])
    for ask in (ARM.solutions, lambda T: ARM.solve(T, 0.0, 0), lambda T: ARM.nearest(T, np.zeros(7))):
        with pytest.raises(OutOfReach, match="farther") as refused:
            ask(pin.SE3(np.eye(3), tip))
        assert refused.value.distance == pytest.approx(excess, abs=1e-12)


def test_too_near_says_by_how_much() -> None:
    folded = math.sqrt(UPPER_ARM**2 + FOREARM**2 - UPPER_ARM * FOREARM)  # elbow at its limit of 120°
    tip = np.array([0.0, 0.0, 0.360 + 0.126]) + (folded - 0.05) * np.array([1.0, 0.0, 0.0])
    with pytest.raises(OutOfReach, match="nearer") as refused:
        ARM.solutions(pin.SE3(np.eye(3), tip))
    assert refused.value.distance == pytest.approx(0.05, abs=1e-12)
    with pytest.raises(OutOfReach):
        ARM.solutions(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.360 + 0.126])))


def test_edges_of_the_reach_are_reached() -> None:
    straight = np.array([0.3, 0.8, 0.1, 0.0, -0.4, 0.9, 0.2])
    folded = np.array([0.3, 0.8, 0.1, UPPER[3], -0.4, 0.9, 0.2])
    for q in (straight, folded):
        T = ROBOT.forward_kinematics(q)
        solved = ARM.nearest(T, q)
        assert pose_difference(ROBOT.forward_kinematics(solved), T) < 2e-10
        # The straight elbow loses half of the digits: the reach depends on it in second order only.
        assert np.abs(solved - q).max() < 1e-7


def test_limits_forbid_a_pose_within_reach() -> None:
    narrow = replace(ROBOT.limits, position_lower=np.full(7, -0.05), position_upper=np.full(7, 0.05))
    T = ROBOT.forward_kinematics(np.array([1.0, 0.04, 0.0, 0.04, 0.0, 0.9, 0.0]))
    with pytest.raises(OutOfReach, match="limits") as refused:
        SrsKinematics(ARM.lengths, narrow).nearest(T, np.zeros(7))
    assert refused.value.distance == 0.0


def test_admissible_arm_angles_separate_allowed_from_forbidden() -> None:
    checked = 0
    for q in random_postures(20, seed=5):
        T, branch = ROBOT.forward_kinematics(q), ARM.branch(q)
        own, intervals = ARM.arm_angle(q), ARM.admissible_arm_angles(T, branch)
        for start, end in intervals:
            assert start < end
            ARM.solve(T, 0.5 * (start + end), branch)
            if end - start < 2.0 * math.pi - 1e-9:
                for inside, outside in ((start + 1e-9, start - 1e-9), (end - 1e-9, end + 1e-9)):
                    ARM.solve(T, inside, branch)
                    with pytest.raises(OutOfReach):
                        ARM.solve(T, outside, branch)
                    checked += 1
        # An interval narrower than the grid of 1° may be missed; none of these postures sits in one.
        assert any((own - start) % (2.0 * math.pi) <= end - start + 1e-9 for start, end in intervals)
    assert checked > 20


def test_nearest_agrees_with_brute_force() -> None:
    weight = 1.0 / ROBOT.limits.velocity
    random = np.random.default_rng(6)
    for q in random_postures(25, seed=7):
        T, reference = ROBOT.forward_kinematics(q), random.uniform(LOWER, UPPER)
        dense = ARM.scan(T, 20_000).configurations
        brute = (((dense - reference) * weight) ** 2).sum(axis=1).min()
        nearest = ARM.nearest(T, reference)
        cost = (((nearest - reference) * weight) ** 2).sum()
        assert pose_difference(ROBOT.forward_kinematics(nearest), T) < 1e-9
        # The dense grid of 3e-4 rad misses a minimum by its square, one at a limit by the slope of about 10 times it.
        assert brute - 1e-2 < cost < brute + 1e-9


def test_nearest_returns_a_reference_that_reaches_the_pose() -> None:
    for q in random_postures(100, seed=8):
        assert np.abs(ARM.nearest(ROBOT.forward_kinematics(q), q) - q).max() < 1e-9


def test_follow_keeps_arm_angle_and_branch_and_says_where_it_cannot() -> None:
    random = np.random.default_rng(12)
    references = random.uniform(LOWER, UPPER, (400, 7))
    moves = [pin.exp6(random.normal(size=6) * size) for size in np.repeat([0.01, 0.3], 200)]
    poses = [ARM.forward_kinematics(q) * move for q, move in zip(references, moves, strict=True)]
    found, turn = ARM.follow(np.array([T.homogeneous[:3] for T in poses]), references)
    wanted = np.full((400, 7), np.nan)
    for k, (T, q) in enumerate(zip(poses, references, strict=True)):
        with contextlib.suppress(OutOfReach):
            wanted[k] = ARM.solve(T, ARM.arm_angle(q), ARM.branch(q))
    refused = np.isnan(wanted).any(axis=1)
    assert 20 < refused.sum() < 380
    # the same closed form, so to the last bits of an angle
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-12)
    assert math.isnan(turn)
    near = np.array([T.homogeneous[:3] for T in poses])[~refused]
    assert ARM.follow(near, references[~refused])[1] == np.abs(found - references)[~refused].max()


def test_null_space_rate_turns_the_elbow_at_unit_rate_and_holds_the_flange() -> None:
    h, checked = 1e-6, 0
    for q in random_postures(300, seed=9):
        rate = ARM.null_space_rate(q)
        assert np.abs(ROBOT.jacobian(q) @ rate).max() < 1e-9
        if far_from_singular(q, 0.05):
            # Central differences of third derivatives up to 1/sin³: 1e-12 · 1e4, and rounding 1e-16 / h · 1/sin².
            ahead, behind = (ARM.arm_angle(q + step * rate) for step in (h, -h))
            assert math.remainder(ahead - behind, 2.0 * math.pi) / (2.0 * h) == pytest.approx(1.0, abs=1e-5)
            checked += 1
    assert checked > 200


@settings(max_examples=200)
@given(st.one_of(lined_up_postures(), postures()))
def test_null_space_rate_holds_the_flange_even_where_joints_line_up(q: np.ndarray) -> None:
    rate = ARM.null_space_rate(q)
    assert np.linalg.norm(rate) > 0.5
    # Rates grow as 1/sin up to 1e6; the product with J rounds in proportion.
    assert np.abs(ROBOT.jacobian(q) @ rate).max() < 1e-9


def test_straight_arm_keeps_the_unit_swivel_rate() -> None:
    np.testing.assert_allclose(ARM.null_space_rate(np.zeros(7)), [1.0, 0, 0, 0, -1.0, 0, 0], atol=1e-15)


def test_bad_input_is_refused() -> None:
    T = ROBOT.forward_kinematics(np.full(7, 0.3))
    with pytest.raises(InvalidProblem, match="branch 8"):
        ARM.solve(T, 0.0, 8)
    with pytest.raises(InvalidProblem, match="arm angle nan"):
        ARM.solve(T, math.nan, 0)
    with pytest.raises(InvalidProblem, match="shape"):
        ARM.arm_angle(np.zeros(6))
    with pytest.raises(InvalidProblem, match="not finite"):
        ARM.solutions(pin.SE3(np.eye(3), np.array([np.nan, 0.0, 0.0])))
    with pytest.raises(InvalidProblem, match="q_reference"):
        ARM.nearest(T, np.full(7, np.inf))
    with pytest.raises(InvalidProblem, match=r"\(K, 7\)"):
        ARM.follow(T.homogeneous[None, :3], np.zeros((2, 7)))
    with pytest.raises(InvalidProblem, match="positive"):
        SrsKinematics(np.array([0.36, 0.0, 0.4, 0.126]), ROBOT.limits)
    with pytest.raises(InvalidProblem, match="lengths"):
        SrsKinematics(np.array([0.36, 0.42, 0.4]), ROBOT.limits)


def test_a_model_file_that_claims_the_wrong_chain_is_refused() -> None:
    swapped = SrsLengths(base_to_shoulder=0.36, shoulder_to_elbow=0.40, elbow_to_wrist=0.42, wrist_to_flange=0.126)
    with pytest.raises(ModelFileError, match="general"):
        SrsKinematics.from_robot(replace(ROBOT, srs=swapped))
