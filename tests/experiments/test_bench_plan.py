"""The planning benchmark on few problems: what it counts, what it compares, what it refuses."""

import json

import numpy as np
import pytest

from dyngrasp.cli.arguments import argument_parser
from dyngrasp.errors import DyngraspError
from dyngrasp.experiments.bench_plan import SAME, WARM, Attempt, PlanBenchmark, bench_plan
from dyngrasp.experiments.output import write_json
from dyngrasp.experiments.serial_chain import serial_chain


@pytest.fixture(scope="module")
def measured():
    return bench_plan(2, seed=4, weights=(1.0,), grids=(20, 40), joints=(3,))


def test_every_trial_and_stage_is_there(measured):
    rows = measured.stage_rows()
    for case in ("paper", "stress"):
        stages = {row["stage"]: row for row in rows if row["case"] == case}
        assert {"targets", "problems", "approach", "grasp", "deliver", "audit", "rest", "plan"} == set(stages)
        assert all(row["n"] == 2 for row in stages.values())
        parts = [s for s in measured.stages if s.case == case and s.trial == 0]
        whole = next(s.time_ms for s in parts if s.stage == "plan")
        assert sum(s.time_ms for s in parts if s.stage != "plan") == pytest.approx(whole, rel=1e-9)
        assert all(s.time_ms >= 0 for s in parts)


def test_phases_are_solved_and_measured_independently(measured):
    rows = measured.phase_rows()
    assert [row["solver"] for row in rows].count(WARM) == 6
    assert len(rows) == 12
    for row in rows:
        assert row["ok"] == row["n"] == 2
        assert row["worst_violation"] <= 1e-9
        assert row["objective"] > 0


def test_growth(measured):
    sizes = [(row["joints"], row["intervals"], row["ok"]) for row in measured.growth]
    assert sizes == [(7, 20, 2), (7, 40, 2), (3, 100, 2)]


def test_the_same_seed_draws_the_same_problems(measured):
    again = bench_plan(2, seed=4, weights=(1.0,), grids=(), joints=())
    assert [a.objective for a in again.attempts] == [a.objective for a in measured.attempts]


def test_report_is_json(measured, tmp_path):
    write_json(tmp_path / "bench.json", measured.report())
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    keys = {"backend", "part", "rho", "grid", "joints", "solved", "median_ms", "p99_ms", "max_ms", "n"}
    assert all(keys <= row.keys() for row in rows)
    paper = {(row["part"], row["start"]): row for row in rows if row["case"] == "paper"}
    assert {"phase1", "phase2", "phase3", "whole", "audit"} <= {part for part, _ in paper}
    assert (paper["whole", "cold"]["grid"], paper["whole", "cold"]["joints"]) == (100, 7)
    assert {"objective_rel_diff", "worst_violation"} <= paper["phase1", "warm"].keys()


def test_objectives_are_reported_relative_to_the_reference():
    attempts = [
        Attempt("paper", 1.0, trial, "approach", solver, 1.0, 5, objective, 0.0, True)
        for solver, objectives in (("structured", (1.1, 2.0, 3.3)), ("ipopt", (1.0, 2.0, 3.0)))
        for trial, objective in enumerate(objectives)
    ]
    ours, theirs = PlanBenchmark(tuple(attempts), (), (), ("ipopt",), 100, 7).report()["rows"]
    assert (ours["part"], ours["backend"], theirs["backend"]) == ("phase1", "structured", "ipopt")
    assert ours["objective_rel_diff"] == pytest.approx(0.1)
    assert theirs["objective_rel_diff"] == 0.0


def test_comparison_counts_pairs():
    def attempt(trial, solver, objective, time_ms, ok=True):
        return Attempt("paper", 1.0, trial, "approach", solver, time_ms, 5, objective, 0.0, ok)

    pairs = [(1.0, 1.0), (1.0, 1.0 + 10 * SAME), (1.0 + 10 * SAME, 1.0)]
    attempts = [attempt(i, "structured", ours, 1.0) for i, (ours, _) in enumerate(pairs)]
    attempts += [attempt(i, "ipopt", theirs, 40.0) for i, (_, theirs) in enumerate(pairs)]
    attempts += [attempt(3, "structured", 1.0, 1.0), attempt(3, "ipopt", np.nan, 90.0, ok=False)]
    (row,) = PlanBenchmark(tuple(attempts), (), (), ("ipopt",), 100, 7).comparison_rows()
    assert (row["same"], row["better"], row["worse"]) == (1, 1, 1)
    assert (row["problems"], row["both"], row["only_ours"], row["only_theirs"]) == (4, 3, 1, 0)
    assert row["speedup"] == 40.0


def test_an_unknown_peer_is_refused():
    with pytest.raises(DyngraspError, match="snopt"):
        bench_plan(1, 0, against=("snopt",))


@pytest.mark.slow
def test_against_ipopt():
    found = bench_plan(1, seed=1, weights=(1e-3,), against=("ipopt",), grids=(), joints=())
    rows = found.comparison_rows()
    assert len(rows) == 6
    assert all(row["both"] == 1 for row in rows)
    assert all(row["speedup"] > 3 for row in rows)
    assert all(row["same"] == 1 for row in rows if row["phase"] != "approach")


def test_arguments():
    options = argument_parser("0").parse_args(["bench", "plan", "--rho", "1", "0.001", "--against", "ipopt"])
    assert (options.command, options.benchmark, options.trials, options.seed) == ("bench", "plan", 200, 0)
    assert options.rho == [1.0, 1e-3]
    for wrong in (["--rho", "-1"], ["--rho", "nan"], ["--trials", "0"]):
        with pytest.raises(SystemExit):
            argument_parser("0").parse_args(["bench", "plan", *wrong])


@pytest.mark.parametrize("joints", [1, 2, 6, 9])
def test_chains_can_hold_themselves(joints):
    robot = serial_chain(joints)
    assert robot.n == joints
    random = np.random.default_rng(joints)
    worst = max(
        float((np.abs(robot.gravity_torque(random.uniform(-3, 3, joints))) / robot.limits.torque).max())
        for _ in range(200)
    )
    assert worst < 1.0
