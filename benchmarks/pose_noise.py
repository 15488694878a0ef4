"""The noise model's parameters, fitted to what a rendered camera makes of a part that the hand nears.

    python benchmarks/pose_noise.py --films 24 --seed 3 --out docs/figures

Films approaches in pictures of the camera's own size, a quarter of a minute each, and runs them through detection and
filter. Prints the keys of `[pose]` and a table; writes pose_noise.png and pose_noise.json. The defaults of
`PoseNoiseSettings` and of scenarios are these keys, rounded.
"""

from __future__ import annotations

import argparse

import numpy as np

from dyngrasp.experiments.filmed_approach import film_set
from dyngrasp.experiments.output import OutputFolder, write_json
from dyngrasp.experiments.pose_noise_fit import fit_pose_noise, pose_errors
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.models.catalogue import load_camera, load_gripper
from dyngrasp.report.figures import save_figure
from dyngrasp.report.pose_noise_figure import pose_noise_figure


def main() -> None:
    """Film, fit, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--films", type=int, default=24, help="approaches; 8 at least make a fit worth its name")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", default="out/pose_noise")
    options = parser.parse_args()
    rng, films = np.random.default_rng(options.seed), []
    camera = load_camera("ava1000")
    with OutputFolder(options.out) as out:
        with film_set(camera, seed=options.seed) as stage:
            for number in range(options.films):
                films.append(stage.shoot(rng))
                print(f"film {number + 1} of {options.films}", flush=True)
        fit = fit_pose_noise(pose_errors(films, camera, stage.part, load_gripper("sdh2"), options.seed))
        for key, value in fit.parameters().items():
            print(f"{key} = {value:.4g}")
        for row in fit.rows():
            print("  ".join(f"{key} {value:.3g}" for key, value in row.items() if key != "stage"))
        arguments = {"films": options.films, "seed": options.seed}
        document = {"arguments": arguments, "parameters": fit.parameters(), "rows": fit.rows()}
        write_json(out / "pose_noise.json", document | {"machine": machine(), "versions": versions()})
        save_figure(pose_noise_figure(fit), out / "pose_noise.png")


if __name__ == "__main__":
    main()
