"""A picture for the README: some moments of a film that `dyngrasp run` wrote, side by side.

python scripts/film_strip.py out/relocated_sdh2/episode.mp4 docs/figures/relocated.jpg 0.3 2.2 2.9 4.3
"""

from __future__ import annotations

import argparse
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

# The share of the width that is cut off to the right, where there is only floor.
FLOOR = 0.22


def main() -> None:
    """Take the frames nearest to the moments and write them as one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("film", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("times", type=float, nargs="+", help="seconds from the beginning of the film")
    options = parser.parse_args()
    frames = imageio_ffmpeg.read_frames(str(options.film))
    about = next(frames)
    width, height = about["size"]
    wanted = [round(t * about["fps"]) for t in options.times]
    chosen = {}
    for k, pixels in enumerate(frames):
        if k in wanted:
            frame = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3)
            chosen[k] = frame[:, : round((1 - FLOOR) * width)]
    missing = [t for t, k in zip(options.times, wanted, strict=True) if k not in chosen]
    if missing:
        raise SystemExit(f"{options.film} has no frame at {missing} s")
    border = np.full((chosen[wanted[0]].shape[0], 6, 3), 255, dtype=np.uint8)
    strip = np.hstack([part for k in wanted for part in (chosen[k], border)][:-1])
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(strip).resize((strip.shape[1] // 2, strip.shape[0] // 2)).save(options.picture, quality=88)


if __name__ == "__main__":
    main()
