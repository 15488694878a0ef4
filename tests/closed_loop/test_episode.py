"""A whole grasp in physics: it succeeds when it should, and fails when it must."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.episode import EpisodeSettings
from dyngrasp.closed_loop.record import ARRAY_NAMES
from dyngrasp.errors import InvalidProblem
from dyngrasp.experiments.metrics import judge
from dyngrasp.simulation.plant import ContactCategory


def verdict(planned, record):
    return judge(planned.plan, record, planned.task, planned.targets.grasp)


def test_the_part_is_delivered(planned, delivered):
    outcome = verdict(planned, delivered)
    assert outcome.success, outcome.cause
    # 1 mm at the pads; measured 0.1 to 0.2 mm.
    assert outcome.details["tracking_at_grasp_rad"] < 3e-3
    assert -0.06 < outcome.details["clamp_delay_s"] < 0.02


def test_same_seed_same_record(planned):
    short = EpisodeSettings(hold_time=0.0, record_rate=50.0)
    first, again, other = planned.run(seed=3, settings=short), planned.run(seed=3, settings=short), planned.run(seed=4)
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name), err_msg=name)
    assert not np.array_equal(first.part_position[-1], other.part_position[-1])


def test_slippery_pads_drop_the_part(planned):
    # 2 μ N = 2 · 0.15 · 14 N is just over half the part's weight.
    outcome = verdict(planned, planned.run(friction=0.15))
    assert not outcome.success
    assert not outcome.summary()["held"]
    assert outcome.cause.startswith(("lifted", "held"))


def test_a_part_turned_out_of_the_hands_way_is_not_delivered(planned):
    # Three centimetres across the rib: a finger comes down on the part instead of beside it.
    off = pin.SE3(np.eye(3), np.array([0.0, 0.03, 0.0]))
    outcome = verdict(planned, planned.run(error=off))
    assert not outcome.success
    assert outcome.cause.startswith(("clear", "undisturbed"))


@pytest.mark.parametrize("across", [0.0, 1.0])
def test_an_error_along_the_rib_goes_into_the_placement(planned, delivered, across):
    off = pin.SE3(np.eye(3), np.array([4e-3 * (1 - across), 1e-3 * across, 0.0]))
    offset_object = planned.targets.grasp.T_object_grasp.rotation[:, :2] @ np.array(
        [4e-3 * (1 - across), 1e-3 * across]
    )
    outcome = verdict(planned, planned.run(error=pin.SE3(off.rotation, offset_object)))
    assert outcome.success, outcome.cause
    exact = verdict(planned, delivered).summary()["place_mm"]
    moved = outcome.summary()["place_mm"]
    # Across the rib the fingers centre the part; along it nothing does.
    expected = (exact, exact + 1.0) if across else (3.0, 5.5)
    assert expected[0] - 0.7 < moved < expected[1]


def test_the_part_moves_only_once_it_is_touched(planned, delivered):
    touched = delivered.touched(ContactCategory.PADS_PART)
    first = int(touched.argmax())
    assert touched.any()
    # At rest on the ground, contact yields by micrometres.
    np.testing.assert_allclose(
        delivered.part_position[:first], np.tile(delivered.part_position[0], (first, 1)), atol=2e-5
    )


def test_contacts_and_pad_forces_tell_the_same_story(planned, delivered):
    after = delivered.t > planned.plan.phase_ends[1] + 0.2
    weight = planned.task.grasp_object.mass * 9.81
    assert delivered.touched(ContactCategory.PADS_PART)[after].all()
    assert not delivered.touched(ContactCategory.PART_GROUND)[after].any()
    assert not delivered.touched(ContactCategory.OTHER_ROBOT_PART).any()
    squeeze = delivered.pad_force[after]
    # Friction can only carry the weight if the pads press with m g / 2 μ; more than the motors give is impossible.
    assert (squeeze > weight / (2 * 0.9)).all()
    assert (squeeze.mean(axis=0) < planned.task.gripper.pinch_force).all()


def test_progress_is_reported_in_order(planned):
    seen = []
    planned.run(
        settings=EpisodeSettings(hold_time=0.0, record_rate=20.0), progress=lambda t, phase: seen.append((t, phase))
    )
    times = [t for t, _ in seen]
    assert times == sorted(times)
    assert len(seen) == pytest.approx(planned.plan.end_time * 20, abs=1.5)
    assert list(dict.fromkeys(phase for _, phase in seen)) == ["approach", "grasp", "deliver"]


def test_a_plant_with_another_step_than_the_clock_is_refused(planned):
    with pytest.raises(InvalidProblem, match="control period"):
        planned.run(settings=EpisodeSettings(control_period=0.5e-3))
