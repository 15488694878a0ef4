"""A part that rides on a conveyor, from draw to verdict."""

from pathlib import Path

import numpy as np
import pytest

from dyngrasp.errors import OutOfReach
from dyngrasp.experiments.draws import draw_trial, trial_seed
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.trial import execute_trial, plan_trial, planner_for
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.planning.audit import audit
from dyngrasp.planning.grasp_targets import grasp_targets

SCENARIOS = Path(__file__).parents[2] / "scenarios"
SCENARIO = SCENARIOS / "conveyor_sdh2.toml"
SEED = trial_seed(1, 0)


def workcell(*overrides, path=SCENARIO):
    return load_workcell(load_scenario(path, overrides), path)


@pytest.fixture(scope="module")
def planned():
    cell = workcell()
    planner, trial = planner_for(cell), draw_trial(cell, SEED)
    return cell, trial, planner, plan_trial(cell, trial, planner)


def test_speeds_and_what_is_believed_of_them_stay_within_their_bounds():
    cell = workcell()
    trials = [draw_trial(cell, trial_seed(3, i)) for i in range(100)]
    speeds = np.array([np.linalg.norm(trial.twist_world) for trial in trials])
    ratios = np.array([np.linalg.norm(trial.twist_believed) for trial in trials]) / speeds
    assert 0.05 <= speeds.min() < 0.055
    assert 0.095 < speeds.max() <= 0.1
    assert 0.8 <= ratios.min() < 0.82
    assert 1.18 < ratios.max() <= 1.2
    headings = np.rad2deg([np.arctan2(trial.twist_world[1], trial.twist_world[0]) for trial in trials])
    assert (np.abs(headings - 90.0) <= 10.0).all()


def test_a_conveyor_leaves_the_other_draws_as_they_are():
    still = draw_trial(workcell(path=SCENARIOS / "static_sdh2.toml"), SEED)
    moving = draw_trial(workcell("pose.draw=ball", "pose.position_mm=1.0", "pose.rotation_deg=0.5"), SEED)
    assert still.variation.friction == moving.variation.friction
    np.testing.assert_array_equal(still.T_world_object.rotation, moving.T_world_object.rotation)
    assert not still.twist_world.any()
    assert still.conveyor is None


def test_the_first_plan_meets_the_part_where_it_is_believed_to_be_then(planned):
    cell, trial, _, first = planned
    plan, targets = first.result.require(), first.targets
    assert plan.phase_ends[1] == pytest.approx(targets.grasp_time, abs=1e-9)
    expected = trial.T_world_object_believed.translation + targets.grasp_time * trial.twist_believed[:3]
    np.testing.assert_allclose(targets.T_world_object.translation, expected, atol=1e-12)
    assert audit(plan, targets, cell.task).ok


def test_at_the_grasp_the_hand_has_the_velocity_of_the_part_and_of_the_lift(planned):
    cell, trial, _, first = planned
    plan, task = first.result.require(), cell.task
    q, w = plan.arm[1].position[-1], plan.arm[1].velocity[-1]
    twist = task.robot.jacobian(q) @ w
    # The part does not turn, so every point of the hand moves alike.
    lift = np.array([0.0, 0.0, task.settings.lift_speed])
    np.testing.assert_allclose(twist[:3], trial.twist_believed[:3] + lift, atol=1e-9)
    np.testing.assert_allclose(twist[3:], 0.0, atol=1e-9)


def test_a_riding_part_is_delivered_with_replanning_and_not_without(planned):
    cell, trial, planner, first = planned
    executed = execute_trial(cell, trial, first, planner=planner)
    assert executed.outcome.success, executed.outcome.cause
    # It rode farther than any criterion allows a part to be pushed: the criterion takes the plate's motion off.
    rode = executed.record.support_position[executed.record.index_at(executed.plan.phase_ends[1])]
    assert np.linalg.norm(rode) > 0.15
    assert executed.outcome.summary()["undisturbed_mm"] < 3.0
    without = workcell("replanner.enabled=false")
    assert not execute_trial(without, trial, first, planner=planner).outcome.success


def test_a_part_that_is_not_yet_in_reach_is_met_where_it_will_be(planned):
    cell = workcell("part.y_m=-0.6", "conveyor.speed_m_s=0.15", "part.x_m=0.66")
    trial = draw_trial(cell, SEED)
    with pytest.raises(OutOfReach):
        grasp_targets(trial.T_world_object, cell.task, cell.q_start)
    found = plan_trial(cell, trial, planned[2])
    assert found.result.ok, found.result.message
    assert audit(found.result.require(), found.targets, cell.task).ok


def test_a_part_that_rides_away_is_out_of_reach(planned):
    cell = workcell("part.y_m=0.8", "conveyor.speed_m_s=0.2")
    with pytest.raises(OutOfReach):
        plan_trial(cell, draw_trial(cell, SEED), planned[2])
