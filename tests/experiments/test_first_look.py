"""From the first look of a scenario's camera to a plan: only what was seen counts, and the clock goes on."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.cli import main
from dyngrasp.closed_loop.first_look import FirstLook
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import InvalidProblem, RenderingUnavailable
from dyngrasp.experiments.draws import draw_trial, trial_seed
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.trial import plan_trial, planner_for
from dyngrasp.experiments.trial_summary import study_row, summary
from dyngrasp.experiments.trial_world import first_look, trial_world
from dyngrasp.experiments.vision import recorded_poses
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.planning.audit import audit
from dyngrasp.planning.grasp_targets import moved
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation import gl_backend

SCENARIOS = Path(__file__).parents[2] / "scenarios"
CAMERA = SCENARIOS / "camera_sdh2.toml"
START = 0.32


def workcell(path, *overrides):
    return load_workcell(load_scenario(path, ("planner.intervals=30", *overrides)), path)


def look_at(cell, trial, T_seen, twist=None):
    """A look that found the part at `T_seen`, 0.2 s before the motion begins."""
    with trial_world(cell, trial, filmed=False) as world:
        truth = world.plant.truth()
    estimate = PoseEstimate(T_seen, 1e-6 * np.eye(6), START - 0.2, START - 0.2, np.zeros(6) if twist is None else twist)
    return FirstLook(0.0, START - 0.2, START, estimate, 1e-3, truth)


def test_a_part_at_rest_is_planned_for_where_it_was_seen():
    cell = workcell(CAMERA)
    trial, planner = draw_trial(cell, 3), planner_for(cell)
    seen = trial.T_world_object * pin.SE3(pin.utils.rotate("z", 0.05), np.array([0.02, -0.01, 0.0]))
    planned = plan_trial(cell, trial, planner, look_at(cell, trial, seen))
    plan = planned.result.require()
    assert plan.start_time == START
    np.testing.assert_array_equal(planned.targets.T_world_object.homogeneous, seen.homogeneous)
    # The truth has no part in it.
    elsewhere = replace(trial, T_world_object=pin.SE3.Identity())
    again = plan_trial(cell, elsewhere, planner, look_at(cell, trial, seen)).result.require()
    np.testing.assert_array_equal(again.arm[0].position, plan.arm[0].position)


def test_a_moving_part_is_met_where_it_was_seen_to_go():
    cell = workcell(SCENARIOS / "conveyor_camera_sdh2.toml")
    trial, planner = draw_trial(cell, 3), planner_for(cell)
    twist = np.array([0.0, 0.07, 0.0, 0.0, 0.0, 0.0])
    planned = plan_trial(cell, trial, planner, look_at(cell, trial, trial.T_world_object, twist))
    plan, targets = planned.result.require(), planned.targets
    assert plan.start_time == START
    assert targets.grasp_time == pytest.approx(plan.phase_ends[1], abs=1e-9)
    expected = moved(trial.T_world_object, twist, targets.grasp_time - (START - 0.2))
    np.testing.assert_allclose(targets.T_world_object.translation, expected.translation, atol=1e-12)
    assert audit(plan, targets, cell.task).ok


def test_nobody_tells_where_a_part_is_that_the_camera_has_to_find():
    cell = workcell(CAMERA)
    trial = draw_trial(cell, 1)
    assert trial.T_world_object_believed is None
    with pytest.raises(InvalidProblem, match="first look"):
        plan_trial(cell, trial, planner_for(cell))
    # Other sources do tell, and the part lies where it lay.
    told = draw_trial(workcell(CAMERA, "pose.source=noise"), 1)
    assert told.T_world_object_believed is not None
    assert told.T_world_object == trial.T_world_object


def rendered():
    try:
        gl_backend.require()
    except RenderingUnavailable as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("index", [0, 3])
def test_the_camera_finds_the_part_from_where_the_motion_starts(index, tmp_path):
    rendered()
    cell = workcell(CAMERA)
    trial = draw_trial(cell, trial_seed(5, index))
    with trial_world(cell, trial) as world:
        look = first_look(cell, world)
        vision = world.vision()
    assert look is not None
    assert look.estimate is not None
    assert vision is not None
    # Four pictures that agree, the first at once, each 14 ms on its way.
    assert look.ended == pytest.approx(3 / 30 + 0.014, abs=4e-3)
    figures = summary(cell, trial, look, None, None, vision)["first_look"]
    assert figures["frames"] == figures["with_markers"] == 4
    # From 0.8 m, with 0.1° and 0.5 mm of the mount: 2 mm or so, and what a marker of 30 pixels gives of its tilt.
    assert 0 < figures["error_mm"] < 5
    assert 0 < figures["error_deg"] < 2
    assert figures["deviation_mm"] < cell.scenario.camera.look_mm
    # The same frames, stored, say the same to the last bit, with nothing believed beforehand.
    vision.save(tmp_path / "vision.npz")
    source = recorded_poses(cell, VisionRecord.load(tmp_path / "vision.npz"))
    assert source.tracker.prior is None
    again = source.estimate(None, look.ended)
    np.testing.assert_array_equal(again.T_world_object.homogeneous, look.estimate.T_world_object.homogeneous)
    np.testing.assert_array_equal(again.covariance, look.estimate.covariance)


@pytest.mark.parametrize("command", ["run", "plan"])
def test_a_part_that_is_not_seen_is_an_outcome(command, tmp_path, capsys):
    rendered()
    # Behind the arm.
    hidden = ["--set", "part.x_m=-0.6", "--set", "camera.look_s=0.1", "--set", "camera.keep_every=2"]
    assert main([command, str(CAMERA), *hidden, "--out", str(tmp_path / "out")]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "first look: the part was not found within 0.1 s" in printed
    if command == "run":
        assert "First look 0.10 s 3 pictures, 0 with markers" in printed
        document = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert not document["success"]
        assert document["cause"].startswith("first look:")
        assert document["first_look"]["with_markers"] == 0
        # What it looked at is there to be looked at.
        assert (tmp_path / "out" / "pictures" / "0000.png").exists()
        assert not (tmp_path / "out" / "plan.json").exists()


def test_a_part_that_is_not_seen_is_a_row_of_a_study():
    rendered()
    cell = workcell(CAMERA, "part.x_m=-0.6", "camera.look_s=0.1")
    row = study_row(cell, draw_trial(cell, 1), planner_for(cell))
    assert row["success"] is False
    assert row["cause"].startswith("first look:")
    assert (row["look_frames"], row["look_deviation_mm"]) == (3, None)
    assert row["look_s"] == pytest.approx(0.1, abs=1e-9)
    assert "error_deg" not in row
