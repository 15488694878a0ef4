"""Many seeded trials in local processes, one row each."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from dyngrasp.errors import DyngraspError, InvalidProblem
from dyngrasp.experiments.draws import draw_trial, trial_seed
from dyngrasp.experiments.output import atomic
from dyngrasp.experiments.scenario import Scenario
from dyngrasp.experiments.statistics import Proportion, timing_summary, wilson
from dyngrasp.experiments.trial import planner_for
from dyngrasp.experiments.trial_summary import study_row
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.models.model_file import decode

_COLUMNS = {
    "trial": pa.int64(),
    "seed": pa.int64(),
    "success": pa.bool_(),
    "cause": pa.string(),
    "plan_status": pa.string(),
    "grasp": pa.string(),
    "planning_attempts": pa.int64(),
    **dict.fromkeys(
        ("x_m", "y_m", "yaw_deg", "error_along_mm", "error_across_mm", "error_up_mm", "error_deg"), pa.float64()
    ),
    **dict.fromkeys(("friction", "mass_factor", "planning_ms", "trial_ms"), pa.float64()),
    **dict.fromkeys(("approach_s", "grasp_s", "deliver_s"), pa.float64()),
    "undisturbed_mm": pa.float64(),
    "lifted": pa.bool_(),
    "held": pa.bool_(),
    **dict.fromkeys(("slip_mm", "slip_deg", "place_mm", "place_deg", "min_speed_ratio"), pa.float64()),
    "collisions": pa.int64(),
    "limits_ratio": pa.float64(),
    **{
        f"passed_{name}": pa.bool_()
        for name in ("clear", "undisturbed", "lifted", "held", "slip", "placed", "limits", "moving")
    },
    **{
        f"worst_{name}": pa.float64()
        for name in ("position", "velocity", "torque_planned", "torque_plant", "acceleration")
    },
    **dict.fromkeys(("tracking_rms_rad", "tracking_max_rad", "tracking_at_grasp_rad", "clamp_delay_s"), pa.float64()),
    "slip_from_grasp_point_mm": pa.float64(),
    **dict.fromkeys(("replans", "published", "too_uncertain", "look_frames"), pa.int64()),
    **dict.fromkeys(("look_s", "look_deviation_mm"), pa.float64()),
}
SCHEMA = pa.schema(list(_COLUMNS.items()))
"""Columns of a study's table; what a trial did not get to is null."""


@dataclass
class Study:
    """A study and the rows that are finished so far, in the order of the trials."""

    scenario: Scenario
    seed: int
    trials: int
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)

    @property
    def ordered(self) -> list[dict[str, Any]]:
        """Rows in the order of the trials, whichever process finished first."""
        return [self.rows[index] for index in sorted(self.rows)]

    @property
    def delivered(self) -> Proportion:
        """Successes with their 95 % interval."""
        return wilson(sum(bool(row["success"]) for row in self.ordered), len(self.rows))

    def report(self) -> dict[str, Any]:
        """Summary: shares with intervals, how often each criterion failed, times."""
        rows, share = self.ordered, self.delivered
        names = [column.removeprefix("passed_") for column in SCHEMA.names if column.startswith("passed_")]
        return {
            "scenario": self.scenario.name,
            "seed": self.seed,
            "trials": len(rows),
            "delivered": share.successes,
            "share": share.share,
            "low": share.low,
            "high": share.high,
            "planned": sum(row.get("plan_status") == "converged" for row in rows),
            "failed_criterion": {name: sum(row.get(f"passed_{name}") is False for row in rows) for name in names},
            "causes": [{"seed": row["seed"], "cause": row["cause"]} for row in rows if not row["success"]],
            "planning": timing_summary([row["planning_ms"] for row in rows if row.get("planning_ms") is not None]),
        }

    def write_parquet(self, path: str | Path) -> None:
        """Write the finished rows; the file appears whole or not at all."""
        table = pa.Table.from_pylist([{name: row.get(name) for name in SCHEMA.names} for row in self.ordered], SCHEMA)
        with atomic(path) as temporary:
            pq.write_table(table, temporary)


def run_study(
    scenario: Scenario,
    source: str | Path,
    *,
    trials: int,
    seed: int,
    workers: int | None = None,
    progress: Callable[[Study], None] | None = None,
) -> Study:
    """Run seeded trials; the rows depend on scenario, seed and index alone, not on the number of processes.

    Args:
        scenario: What to run.
        source: Its file, named in errors.
        trials: How many.
        seed: Each trial's own seed is drawn from this one and its index.
        workers: Processes; one a core if None.
        progress: Called after each finished trial.

    Returns:
        The study. After Ctrl-C, KeyboardInterrupt carries it as its argument, with the rows finished until then.

    Raises:
        DyngraspError: The scenario's models cannot be loaded.
    """
    if trials < 1 or (workers is not None and workers < 1):
        raise InvalidProblem(f"a study needs at least one trial and one process, got {trials} and {workers}")
    load_workcell(scenario, source)  # once here, so that a bad file is one error and not one a process
    study = Study(scenario, seed, trials)
    workers = min(workers or os.cpu_count() or 1, trials)
    try:
        for index, row in _rows(scenario, str(source), seed, range(trials), workers):
            study.rows[index] = {"trial": index, **row}
            if progress is not None:
                progress(study)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(study) from None
    return study


def _rows(
    scenario: Scenario, source: str, seed: int, indices: range, workers: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Rows as they finish. A process that dies takes its trial with it as a failed row, and the rest goes on."""
    pending = set(indices)
    while pending:
        # spawn: a fork would copy the threads' locks of the libraries that have been imported here.
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (scenario.model_dump(mode="json"), source))
        futures: dict[Future[dict[str, Any]], int] = {
            pool.submit(_run, trial_seed(seed, i)): i for i in sorted(pending)
        }
        lost: list[int] = []
        try:
            for future in as_completed(futures):
                index = futures[future]
                try:
                    row = future.result()
                except BrokenProcessPool:
                    lost.append(index)
                    continue
                pending.discard(index)
                yield index, row
        except (KeyboardInterrupt, GeneratorExit):
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        if lost:
            # Which of the unfinished trials killed its process cannot be told; the first one stands for it.
            index = min(lost)
            pending.discard(index)
            yield index, {"seed": trial_seed(seed, index), "success": False, "cause": "crash: the worker process died"}


_worker: dict[str, Any] = {}


def _begin(scenario: dict[str, Any], source: str) -> None:
    # Ctrl-C reaches the whole process group; the parent decides what happens then.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _worker["workcell"] = load_workcell(decode(Scenario, scenario, source), source)
    _worker["planner"] = planner_for(_worker["workcell"])


def _run(seed: int) -> dict[str, Any]:
    workcell = _worker["workcell"]
    trial = draw_trial(workcell, seed)
    try:
        return study_row(workcell, trial, _worker["planner"])
    except DyngraspError as error:
        return {"seed": seed, "success": False, "cause": f"{type(error).__name__}: {error}"}
    except Exception as error:
        # A defect of ours in one trial must not cost the others; it is a row that says so.
        return {"seed": seed, "success": False, "cause": f"crash: {type(error).__name__}: {error}"}
