"""Poses out of frames that were recorded: the same part of the loop as a running camera, without one."""

from __future__ import annotations

from collections.abc import Iterable

from dyngrasp.perception.part_tracker import Frame, PartTracker
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth


class RecordedPoses:
    """A `PoseSource` that replays frames at the times at which they arrived when they were recorded."""

    def __init__(self, tracker: PartTracker, frames: Iterable[Frame]) -> None:
        """Begin.

        Args:
            tracker: Makes poses of the frames; the settings under trial are its own.
            frames: As recorded, `VisionRecord.frames` say, on the clock of whoever asks.
        """
        self.tracker = tracker
        for frame in sorted(frames, key=lambda frame: frame.t_receipt):
            tracker.expect(frame)

    def estimate(self, truth: Truth | None, t: float) -> PoseEstimate:
        """What the tracker knows at time t (s); nobody looks at the truth."""
        return self.tracker.estimate(t)
