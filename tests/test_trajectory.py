from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngrasp.errors import InvalidTrajectory, PlanFileError
from dyngrasp.signals import frozen
from dyngrasp.trajectory import GraspPlan, Trajectory


def collocated(intervals: int, joints: int, duration: float, seed: int, start=None) -> Trajectory:
    """Integrate random accelerations with the trapezoidal rule, as the planner's dynamics do."""
    rng = np.random.default_rng(seed)
    v = rng.uniform(-2, 2, (intervals + 1, joints))
    step = duration / intervals
    q0, w0 = (np.zeros(joints), np.zeros(joints)) if start is None else start
    w = w0 + np.vstack([np.zeros(joints), np.cumsum(step / 2 * (v[1:] + v[:-1]), axis=0)])
    q = q0 + np.vstack([np.zeros(joints), np.cumsum(step / 2 * (w[1:] + w[:-1]), axis=0)])
    return Trajectory(duration, q, w, v)


def chain(joints: int, durations, seed: int) -> tuple[Trajectory, Trajectory, Trajectory]:
    start, phases = None, []
    for i, duration in enumerate(durations):
        phases.append(collocated(6 + i, joints, duration, seed + i, start))
        start = (phases[-1].position[-1], phases[-1].velocity[-1])
    return tuple(phases)


def plan(start_time: float = 0.4) -> GraspPlan:
    durations = (0.7, 0.3, 1.1)
    return GraspPlan(chain(2, durations, 1), chain(3, durations, 5), start_time, ("a", "b"), ("f", "g", "h"))


@given(st.integers(1, 30), st.floats(0.05, 20.0), st.integers(0, 10_000))
def test_samples_meet_the_grid_points(intervals, duration, seed):
    trajectory = collocated(intervals, 3, duration, seed)
    samples = trajectory.sample_many(trajectory.times)
    # Rounding only: each grid value is a sum of at most 30 terms of this size.
    scale = 1.0 + np.abs(trajectory.position).max()
    for sampled, grid in zip(samples, (trajectory.position, trajectory.velocity, trajectory.acceleration), strict=True):
        np.testing.assert_allclose(sampled, grid, atol=1e-12 * scale * max(duration, 1.0))


def test_velocity_is_the_integral_of_the_acceleration():
    trajectory = collocated(7, 2, 1.3, 3)
    times = np.linspace(0, 1.3, 7 * 400 + 1)
    _, w, v = trajectory.sample_many(times)
    integral = np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(times)[:, None], axis=0)
    np.testing.assert_allclose(w[1:] - w[0], integral, atol=1e-12)  # the trapezoid is exact for linear pieces


def test_position_is_continuous_and_its_rate_misses_the_velocity_by_the_error_of_the_rule():
    trajectory = collocated(9, 2, 0.9, 4)
    step = 0.1
    for k in range(1, 9):
        left = trajectory.sample(k * step - 1e-12).position
        right = trajectory.sample(k * step + 1e-12).position
        np.testing.assert_allclose(left, right, atol=1e-11)
    t = 0.437
    rate = (trajectory.sample(t + 1e-6).position - trajectory.sample(t - 1e-6).position) / 2e-6
    bound = step / 12 * np.abs(np.diff(trajectory.acceleration, axis=0)).max()
    assert np.abs(rate - trajectory.sample(t).velocity).max() <= bound + 1e-8


def test_the_rule_holds_and_a_broken_rule_shows():
    trajectory = collocated(20, 2, 2.0, 0)
    assert trajectory.dynamics_defect() < 1e-14
    bent = trajectory.position.copy()
    bent[7, 1] += 1e-3
    assert Trajectory(2.0, bent, trajectory.velocity, trajectory.acceleration).dynamics_defect() == pytest.approx(1e-3)


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        collocated(4, 1, 1.0, 0).position[0, 0] = 1.0


def test_what_somebody_could_still_write_to_is_copied():
    grid = np.zeros((5, 2))
    view = grid[:]
    view.setflags(write=False)
    trajectory = Trajectory(1.0, view, grid, grid)
    grid[:] = 1.0
    assert not trajectory.position.any()
    assert not trajectory.velocity.any()


def test_what_nobody_can_write_to_is_shared():
    block = frozen(np.zeros((3, 5, 2)))
    trajectory = Trajectory(1.0, *block)
    assert np.shares_memory(trajectory.position, block)
    # other numbers and other layouts are none of its own
    single = np.zeros((3, 5, 2), np.float32)
    single.setflags(write=False)
    assert Trajectory(1.0, *single).position.dtype == float  # type: ignore[arg-type]
    assert Trajectory(1.0, *frozen(np.zeros((3, 2, 5))).transpose(0, 2, 1)).position.flags.c_contiguous


@pytest.mark.parametrize(
    ("duration", "rows", "message"),
    [(0.0, 5, "duration"), (-1.0, 5, "duration"), (float("nan"), 5, "duration"), (1.0, 1, "shape")],
)
def test_what_is_no_trajectory(duration, rows, message):
    with pytest.raises(InvalidTrajectory, match=message):
        Trajectory(duration, *(np.zeros((rows, 2)) for _ in range(3)))


def test_non_finite_numbers_are_refused():
    bad = np.zeros((4, 2))
    bad[2, 0] = np.inf
    with pytest.raises(InvalidTrajectory, match="finite"):
        Trajectory(1.0, np.zeros((4, 2)), np.zeros((4, 2)), bad)


def test_a_plan_runs_on_one_timeline():
    p = plan()
    assert p.end_time == pytest.approx(0.4 + 2.1)
    assert [p.sample(t).phase for t in (0.0, 0.5, 1.1, 1.2, 1.4, 3.0)] == [
        "approach", "approach", "grasp", "grasp", "deliver", "deliver",
    ]  # fmt: skip
    for t in p.phase_ends[:2]:
        before, after = p.sample(t - 1e-10), p.sample(t + 1e-10)
        np.testing.assert_allclose(before.arm.position, after.arm.position, atol=1e-8)
        np.testing.assert_allclose(before.gripper.velocity, after.gripper.velocity, atol=1e-8)


def test_a_plan_is_held_at_rest_after_its_end():
    late = plan().sample(99.0)
    np.testing.assert_allclose(late.arm.position, plan().arm[2].position[-1], rtol=1e-14)
    assert not late.arm.velocity.any()
    assert not late.gripper.acceleration.any()


def test_joins_that_do_not_meet_are_refused():
    p = plan()
    moved = Trajectory(0.3, p.arm[1].position + 1e-6, p.arm[1].velocity, p.arm[1].acceleration)
    with pytest.raises(InvalidTrajectory, match=r"position jumps by 1\.00e-06 between approach and grasp"):
        GraspPlan((p.arm[0], moved, p.arm[2]), p.gripper, 0.0, p.arm_joints, p.gripper_joints)


def test_arm_and_gripper_share_their_durations():
    p = plan()
    slow = chain(3, (0.7, 0.4, 1.1), 5)
    with pytest.raises(InvalidTrajectory, match=r"phase grasp: arm takes 0\.3 s, gripper 0\.4 s"):
        GraspPlan(p.arm, slow, 0.0, p.arm_joints, p.gripper_joints)


def frozen_phases(trajectories):
    return tuple((t.duration, t.position, t.velocity, t.acceleration) for t in trajectories)


def test_a_plan_of_arrays_is_the_same_plan():
    p = plan()
    q = GraspPlan.of(frozen_phases(p.arm), frozen_phases(p.gripper), p.start_time, p.arm_joints, p.gripper_joints)
    assert q.arm_joints == p.arm_joints
    assert q.gripper_joints == p.gripper_joints
    assert q.end_time == p.end_time
    assert np.array_equal(q.phase_ends, p.phase_ends)
    assert np.array_equal(q.durations, p.durations)
    for a, b in zip(q.arm + q.gripper, p.arm + p.gripper, strict=True):
        assert a.duration == b.duration
        for name in ("position", "velocity", "acceleration"):
            assert getattr(a, name) is getattr(b, name)
    for t in (0.0, 1.3, 99.0):
        assert np.array_equal(q.sample(t).arm.acceleration, p.sample(t).arm.acceleration)
        assert np.array_equal(q.sample(t).gripper.position, p.sample(t).gripper.position)


@pytest.mark.parametrize("phase", range(3))
@pytest.mark.parametrize("part", ["arm", "gripper"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda T, q, w, v: (T, q + 1e-6, w, v), "position jumps"),
        (lambda T, q, w, v: (T, q, w + 1e-6, v), "velocity jumps"),
        (lambda T, q, w, v: (T, q, w, v + np.where(v == v[1, 0], np.nan, 0.0)), "finite"),
        (lambda T, q, w, v: (T, q, np.where(w == w[-1, -1], np.inf, w), v), "finite"),
        (lambda T, q, w, v: (T, q[:-1], w, v), "shape"),
        (lambda T, q, w, v: (T, q[:1], w[:1], v[:1]), "shape"),
        (lambda T, q, w, v: (T, q[:, :-1].copy(), w[:, :-1].copy(), v[:, :-1].copy()), "columns"),
        (lambda T, q, w, v: (0.0, q, w, v), "duration"),
        (lambda T, q, w, v: (np.nan, q, w, v), "duration"),
        (lambda T, q, w, v: (np.inf, q, w, v), "duration"),
        (lambda T, q, w, v: (T + 1e-6, q, w, v), "arm takes"),
    ],
)
def test_arrays_that_are_no_plan_are_refused_as_ever(phase, part, spoil, message):
    p = plan()
    arm, gripper = list(frozen_phases(p.arm)), list(frozen_phases(p.gripper))
    phases = arm if part == "arm" else gripper
    T, q, w, v = spoil(*phases[phase])
    phases[phase] = T, frozen(np.array(q)), frozen(np.array(w)), frozen(np.array(v))
    with pytest.raises(InvalidTrajectory, match=message):
        GraspPlan.of(tuple(arm), tuple(gripper), 0.0, p.arm_joints, p.gripper_joints)


def test_a_saved_plan_loads_exactly(tmp_path):
    original = plan()
    original.save(tmp_path / "plan.json")
    loaded = GraspPlan.load(tmp_path / "plan.json")
    assert loaded.start_time == original.start_time
    assert loaded.arm_joints == original.arm_joints
    for a, b in zip(original.arm + original.gripper, loaded.arm + loaded.gripper, strict=True):
        for name in ("position", "velocity", "acceleration"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    times = json.loads((tmp_path / "plan.json").read_text())["phases"][1]["times"]
    assert times[0] == pytest.approx(original.phase_ends[0])
    assert times[-1] == pytest.approx(original.phase_ends[1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "format"),
        ('{"format": "dyngrasp.plan", "version": 9}', "version"),
        ('{"format": "dyngrasp.plan", "version": 1}', "`phases`.*missing"),
        ('{"format": "dyngrasp.plan", "version": 1, "phases": [], "start_time": 0, "arm_joints": [], '
         '"gripper_joints": []}', "does not hold a plan"),
    ],
)  # fmt: skip
def test_files_that_hold_no_plan(tmp_path, text, message):
    (tmp_path / "plan.json").write_text(text)
    with pytest.raises(PlanFileError, match=message):
        GraspPlan.load(tmp_path / "plan.json")


def test_a_missing_file(tmp_path):
    with pytest.raises(PlanFileError, match="cannot be read"):
        GraspPlan.load(tmp_path / "none.json")
