"""The picture of the README: four moments of an episode side by side.

python scripts/readme_picture.py out/static_sdh2 docs/figures/grasp.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.simulation.rendering import Renderer, View, close_up
from dyngrasp.simulation.scene import build_scene
from dyngrasp.trajectory import GraspPlan

SIZE = (640, 480)


def main() -> None:
    """Render the moments and write them as one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `dyngrasp run` wrote")
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    record = EpisodeRecord.load(options.run / "record.npz")
    plan = GraspPlan.load(options.run / "plan.json")
    T_1, T_2, T_3 = plan.phase_ends
    scene = build_scene(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"))
    overview = View(lookat=(0.42, -0.03, 0.42), distance=1.75, azimuth_deg=128.0, elevation_deg=-14.0)
    grasp_point = record.grasp_point[record.index_at(T_2)]
    moments = (
        (0.55 * T_1, overview),
        (T_1, close_up(grasp_point)),
        (T_2, close_up(grasp_point)),
        (T_3, overview),
    )
    with Renderer(scene, width=SIZE[0], height=SIZE[1]) as renderer:
        frames = [renderer.frame(record.scene_state[record.index_at(t)], view) for t, view in moments]
    border = np.full((SIZE[1], 6, 3), 255, dtype=np.uint8)
    strip = np.hstack([part for frame in frames for part in (frame, border)][:-1])
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(strip).save(options.picture, quality=88)


if __name__ == "__main__":
    main()
