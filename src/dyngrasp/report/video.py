"""Encode frames to a video that every browser plays."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from dyngrasp.experiments.output import atomic


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: float) -> int:
    """Encode RGB frames as H.264 in an MP4 file.

    Args:
        path: Where the file goes; it appears only when it is complete.
        frames: Images (height, width, 3) of one size, its sides even: H.264 stores colour at half resolution.
        frames_per_second: Playback rate.

    Returns:
        The number of frames written; without any there is no file.

    Raises:
        ValueError: Frames that differ in shape, or are no RGB images of even size.
        OutputError: The file cannot be written.
    """
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        return 0
    height, width = first.shape[:2]
    if first.shape != (height, width, 3) or height % 2 or width % 2:
        raise ValueError(f"RGB frames of even height and width expected, got shape {first.shape}")
    count = 0
    with atomic(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=frames_per_second,  # pyright: ignore[reportArgumentType] ffmpeg takes any rate
            codec="libx264",
            quality=None,  # pyright: ignore[reportArgumentType] None leaves it to -crf
            # The frame size is taken as it is: padding to multiples of 16 would draw a border.
            macro_block_size=2,
            # faststart: the index comes first, so that a browser plays while it still loads.
            output_params=["-crf", "20", "-preset", "medium", "-movflags", "+faststart"],
        )
        writer.send(None)
        try:
            frame: NDArray[np.uint8] | None = first
            while frame is not None:
                if frame.shape != first.shape:
                    raise ValueError(f"frame {count} has shape {frame.shape}, the first one {first.shape}")
                writer.send(np.ascontiguousarray(frame, dtype=np.uint8))
                count += 1
                frame = next(iterator, None)
        finally:
            writer.close()
    return count
