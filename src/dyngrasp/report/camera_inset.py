"""What the camera on the hand sees, as an inset of the video: its picture, the markers found in it, what is known."""

from __future__ import annotations

from bisect import bisect_right
from functools import lru_cache

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.perception.marker_drawing import outlined
from dyngrasp.perception.pose_filter import Verdict

Frame = NDArray[np.uint8]

# The inset's width and its distance from the corner, as shares of the video's width.
SHARE, MARGIN = 0.30, 0.02

# So long after a picture another one is expected (s): later the camera has stopped, and the inset goes.
PATIENCE = 0.4

_ORANGE, _DARK, _LIGHT = (255, 122, 0), "#20252b", "#f0f0f0"
_BORDER, _BORDER_GREY = 2, 240


class CameraInset:
    """Lays the pictures of a record over the frames of a video.

    Upper left: while the camera takes pictures, neither arm nor part get there.
    """

    def __init__(self, vision: VisionRecord, video_width: int) -> None:
        """Begin.

        Args:
            vision: With its pictures.
            video_width: Of the frames (pixels).
        """
        self._reports = vision.reports
        self._pictures = vision.pictures
        self._kept = sorted(vision.pictures)
        self._times = [self._reports[k].frame.t_receipt for k in self._kept]
        taken = (k for k, report in enumerate(self._reports) if report.verdict in (Verdict.ACCEPTED, Verdict.ACQUIRED))
        self._first_taken = next(taken, len(self._reports))
        self._width = round(SHARE * video_width)
        self._margin = round(MARGIN * video_width)
        self._panel = lru_cache(maxsize=2)(self._draw)

    def over(self, frame: Frame, t: float) -> Frame:
        """The frame of time t (s) with the last picture that had arrived by then."""
        place = bisect_right(self._times, t) - 1
        if place < 0 or t > self._times[place] + PATIENCE:
            return frame
        panel = self._panel(self._kept[place])
        height, width = panel.shape[:2]
        inside = slice(self._margin, self._margin + height), slice(self._margin, self._margin + width)
        if frame[inside].shape != panel.shape:  # a video too flat for it
            return frame
        result = frame.copy()
        result[inside] = panel
        return result

    def _draw(self, number: int) -> Frame:
        report = self._reports[number]
        picture = outlined(self._pictures[number], report.frame.markers, self._width, _ORANGE)
        panel = np.vstack([picture, _lettered(self._caption(number), self._width)])
        return np.pad(panel, ((_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0)), constant_values=_BORDER_GREY)

    def _caption(self, number: int) -> str:
        report = self._reports[number]
        count = len(report.frame.markers)
        seen = f"{count} marker{'s' if count > 1 else ''}" if count else "no marker"
        if report.estimate is None or number < self._first_taken:
            return f"camera on the hand: {seen}\npart not recognised yet"
        deviation = 1e3 * np.sqrt(np.linalg.eigvalsh(report.estimate.covariance[:3, :3])[-1])
        return f"camera on the hand: {seen}\npart known to ± {deviation:.1f} mm"


@lru_cache(maxsize=64)
def _lettered(text: str, width: int) -> Frame:
    """A dark strip with two lines of text."""
    dpi = 100.0
    height = round(0.17 * width)
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor=_DARK)
    canvas = FigureCanvasAgg(figure)
    points = 0.052 * width * 72.0 / dpi
    figure.text(0.04, 0.5, text, color=_LIGHT, fontsize=points, va="center", linespacing=1.35)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
