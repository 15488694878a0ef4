"""Plans for parts all over the paper's box: how many are found and pass the audit, how long the motions take.

    python benchmarks/plan_the_box.py --trials 200 --seed 2026 --json box.json

For the default target and the paper's q_T, and for both weights (ρ = 1, the paper's; ρ = 1e-3, nearly time-optimal).
Beside each the same task with stops at the pre-grasp and at the grasp, as planners do that cannot plan through moving
states; the hand still closes during the descent, which such planners do not do either.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngrasp.errors import DyngraspError
from dyngrasp.experiments.draws import draw_trial, trial_seed
from dyngrasp.experiments.output import write_json
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.statistics import timing_summary, wilson
from dyngrasp.experiments.trial import plan_trial, planner_for
from dyngrasp.experiments.workcell import Workcell, load_workcell

SCENARIOS = Path(__file__).resolve().parents[1] / "scenarios"


def stopping(workcell: Workcell) -> Workcell:
    """The same task with the arm at rest at the pre-grasp and at the grasp."""
    still = replace(workcell.task.settings, approach_speed=0.0, lift_speed=0.0, swivel_rate=0.0, swivel_speed_ratio=0.0)
    return replace(workcell, task=replace(workcell.task, settings=still))


def measure(workcell: Workcell, trials: int, seed: int) -> dict:
    """Plan for `trials` parts at their true poses."""
    planner = planner_for(workcell)
    durations, times, failures = [], [], []
    for i in range(trials):
        trial = draw_trial(workcell, trial_seed(seed, i))
        try:
            planned = plan_trial(workcell, trial, planner)
        except DyngraspError as error:
            failures.append({"seed": trial.seed, "cause": str(error)})
            continue
        if not planned.result.ok:
            failures.append({"seed": trial.seed, "cause": planned.result.message})
            continue
        durations.append(planned.result.require().durations)
        times.append(planned.planning_ms)
    phases = np.array(durations).reshape(-1, 3)
    found = wilson(len(durations), trials)
    return {
        "found": found.successes,
        "trials": trials,
        "low": found.low,
        "high": found.high,
        "phase_medians_s": np.median(phases, axis=0).tolist(),
        "whole_median_s": float(np.median(phases.sum(axis=1))),
        "whole_s": phases.sum(axis=1).tolist(),
        "failures": failures,
        **timing_summary(times[1:]),  # the first plan loads compiled code
    }


def main() -> None:
    """Measure and print one line a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    rows = []
    for target in ("static_sdh2", "paper_target"):
        for rho in (1.0, 1e-3):
            path = SCENARIOS / f"{target}.toml"
            exact = ["pose.source=truth", "pose.position_mm=0", "pose.rotation_deg=0", f"planner.effort_weight={rho}"]
            moving = load_workcell(load_scenario(path, exact), path)
            for motion, workcell in (("moving", moving), ("stopping", stopping(moving))):
                row = {
                    "target": target,
                    "rho": rho,
                    "motion": motion,
                    **measure(workcell, options.trials, options.seed),
                }
                rows.append(row)
                phases = " + ".join(f"{t:.2f}" for t in row["phase_medians_s"])
                print(
                    f"{target:13} ρ = {rho:<6g} {motion:9} {row['found']:4d} of {row['trials']} found, "
                    f"{phases} = {row['whole_median_s']:.2f} s (medians), planned in {row['median_ms']:.1f} ms",
                    flush=True,
                )
                for failure in row["failures"][:5]:
                    print(f"    seed {failure['seed']}: {failure['cause']}")
    if options.json:
        write_json(options.json, {"rows": rows, "machine": machine(), "versions": versions()})


if __name__ == "__main__":
    main()
