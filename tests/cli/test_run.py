"""The commands on good input, end to end in physics, on a coarse grid."""

import json
from pathlib import Path

import numpy as np
import pytest

from dyngrasp.cli import main
from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.trajectory import GraspPlan

SCENARIO = str(Path(__file__).parents[2] / "scenarios" / "static_sdh2.toml")
QUICK = ["--set", "planner.intervals=30", "--set", "planner.effort_weight=0.05"]


@pytest.fixture(scope="module")
def delivered(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", SCENARIO, *QUICK, "--out", str(out), "--no-video"]) == 0
    return out


def test_the_summary_has_its_keys(delivered):
    summary = json.loads((delivered / "summary.json").read_text())
    assert summary["success"] is True
    criteria = summary["criteria"]
    for key in ("undisturbed_mm", "lifted", "held", "slip_mm", "slip_deg", "place_mm", "place_deg", "min_speed_ratio"):
        assert key in criteria
    assert criteria["collisions"] == 0
    assert all(criteria["passed"].values())
    assert len(summary["phases"]) == 3
    assert set(summary["worst"]) == {"position", "velocity", "torque_planned", "torque_plant", "acceleration"}
    assert 0 < summary["worst"]["torque_plant"] < 1
    assert summary["planning_ms"] > 0
    assert summary["seed"] == 1
    assert {"dyngrasp", "mujoco", "casadi", "pin"} <= set(summary["versions"])


def test_the_plan_loads_and_is_what_was_carried_out(delivered):
    plan, record = GraspPlan.load(delivered / "plan.json"), EpisodeRecord.load(delivered / "record.npz")
    for k in range(0, len(record), 50):
        np.testing.assert_allclose(record.arm_planned[k], plan.sample(record.t[k]).arm.position, atol=1e-12)


def test_the_figure_is_a_picture(delivered):
    assert (delivered / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    assert not list(delivered.glob(".*")), "no temporary file stays behind"


def test_a_part_that_is_missed_exits_with_one(tmp_path, capsys):
    wrong = ["--set", "pose.position_mm=0", "--set", "pose.across_mm=40"]
    assert main(["run", SCENARIO, *QUICK, *wrong, "--out", str(tmp_path / "out"), "--no-video"]) == 1
    assert "not delivered" in capsys.readouterr().out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["success"] is False
    assert summary["cause"]


def test_the_same_seed_gives_the_same_plan(tmp_path):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    for file in files:
        assert main(["plan", SCENARIO, *QUICK, "--out", str(file), "--seed", "12"]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_models_and_check(capsys):
    assert main(["models"]) == 0
    listed = capsys.readouterr().out
    for name in ("iiwa14", "sdh2", "casting"):
        assert name in listed
    assert main(["check", SCENARIO]) == 0
