from pathlib import Path

import pyarrow.parquet as pq
import pytest

from dyngrasp.experiments.monte_carlo import SCHEMA, run_study
from dyngrasp.experiments.scenario import load_scenario

SCENARIO = Path(__file__).parents[2] / "scenarios" / "static_sdh2.toml"
# Coarse and fast: what is tested is the study, not the motion.
QUICK = ["planner.intervals=30", "planner.effort_weight=0.05"]
# Wall times differ from run to run; everything else may not.
TIMES = {"planning_ms", "trial_ms"}


def without_times(rows):
    return [{key: value for key, value in row.items() if key not in TIMES} for row in rows]


@pytest.fixture(scope="module")
def study():
    return run_study(load_scenario(SCENARIO, QUICK), SCENARIO, trials=2, seed=3, workers=1)


@pytest.mark.slow
def test_rows_do_not_depend_on_the_number_of_processes(study):
    parallel = run_study(load_scenario(SCENARIO, QUICK), SCENARIO, trials=2, seed=3, workers=2)
    assert without_times(parallel.ordered) == without_times(study.ordered)


def test_every_key_of_a_row_is_a_column(study, tmp_path):
    for row in study.ordered:
        assert set(row) <= set(SCHEMA.names)
    study.write_parquet(tmp_path / "trials.parquet")
    table = pq.read_table(tmp_path / "trials.parquet")
    assert table.num_rows == 2
    assert table["seed"].to_pylist() == [row["seed"] for row in study.ordered]
    assert table["undisturbed_mm"].null_count == 0


def test_the_report_counts(study):
    report = study.report()
    assert report["trials"] == 2
    assert report["delivered"] == sum(row["success"] for row in study.ordered) == 2, report["causes"]
    assert report["planning"]["n"] == 2


def test_a_trial_that_cannot_be_planned_is_a_row_with_its_cause():
    scenario = load_scenario(SCENARIO, [*QUICK, "part.x_m=1.4"])
    row = run_study(scenario, SCENARIO, trials=1, seed=0, workers=1).ordered[0]
    assert not row["success"]
    assert row["cause"].startswith("OutOfReach: ")


def test_an_interrupted_study_keeps_its_finished_rows():
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        run_study(load_scenario(SCENARIO, QUICK), SCENARIO, trials=3, seed=3, workers=1, progress=interrupt)
    assert len(stopped.value.args[0].rows) == 1
