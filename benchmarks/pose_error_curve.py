"""How often the part is delivered when its pose is wrong, without replanning: what replanning has to cure.

    python benchmarks/pose_error_curve.py --trials 40 --seed 7 --out docs/figures

Errors of a stated size along and across the rib, on top of the scenario's own 1 mm and 0.5°; the same parts, plants and
signs at every size. Writes pose_error.png and pose_error.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngrasp.experiments.monte_carlo import Study, run_study
from dyngrasp.experiments.output import OutputFolder, write_json
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.report.figures import ErrorCurve, error_curve_figure, save_figure

SCENARIO = Path(__file__).resolve().parents[1] / "scenarios" / "static_sdh2.toml"
SIZES_MM = (2.0, 5.0, 10.0, 20.0, 30.0)
DIRECTIONS = {"along the rib": "along_mm", "across the rib": "across_mm"}


def main() -> None:
    """Run one small study for each direction and size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40, help="trials a point")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--out", default="out/pose_error")
    options = parser.parse_args()
    curves, rows = [], []
    with OutputFolder(options.out) as out:
        for label, key in DIRECTIONS.items():
            studies: list[Study] = []
            for size in SIZES_MM:
                scenario = load_scenario(SCENARIO, [f"pose.{key}={size}"])
                study = run_study(scenario, SCENARIO, trials=options.trials, seed=options.seed, workers=options.workers)
                studies.append(study)
                report = study.report()
                rows.append({"direction": label, "size_mm": size, **report})
                failed = {name: n for name, n in report["failed_criterion"].items() if n}
                print(f"{label:15} {size:4.0f} mm: {study.delivered}; failed {failed}", flush=True)
            curves.append(ErrorCurve(label, SIZES_MM, tuple(study.delivered for study in studies)))
        write_json(out / "pose_error.json", {"rows": rows, "machine": machine(), "versions": versions()})
        save_figure(error_curve_figure(curves, "error of the pose given to the planner (mm)"), out / "pose_error.png")


if __name__ == "__main__":
    main()
