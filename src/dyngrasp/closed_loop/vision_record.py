"""What the camera saw in an episode and what was made of it, stored as one compressed .npz file beside the record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.record_file import RecordFormat
from dyngrasp.models.camera import CameraModel
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.part_tracker import Frame, FrameReport
from dyngrasp.perception.pose_filter import Verdict
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.camera_sensor import Picture

FORMAT = RecordFormat("dyngrasp.vision", 1, "a record of a camera")

ARRAY_NAMES = (
    "t_capture", "t_receipt", "arm_position", "ratio", "verdict",
    "T_world_object", "covariance", "twist_world",
    "marker_frame", "marker_id", "marker_corners",
)  # fmt: skip
"""The arrays of the file. Of K frames: times (K,) in s, arm_position (K, n) in rad at the capture, ratio (K,), verdict
(K,) as text, "" if the filter was not asked; and what it knew at the receipt: T_world_object (K, 4, 4), covariance
(K, 6, 6), twist_world (K, 6), NaN before anything was known. Of M markers in all frames: number of the frame (M,), of
the marker (M,), and its corners (M, 4, 2) in pixels."""


@dataclass(frozen=True, eq=False)
class VisionRecord:
    """Frames of an episode, with what they were worked out with.

    Attributes:
        arm_joints: Names, in the order of `Frame.arm_position`.
        camera: As calibration believed it, mount included.
        prior: What was believed of the part before.
        reports: In the order of receipt.
        pictures: Pictures that were kept, by the number of their frame; files of their own, not part of this one.
        meta: Whatever else belongs to it.
    """

    arm_joints: tuple[str, ...]
    camera: CameraModel
    prior: PoseEstimate | None
    reports: tuple[FrameReport, ...]
    pictures: Mapping[int, Picture] = field(default_factory=lambda: MappingProxyType({}))
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """What a tracker needs to repeat it all."""
        return tuple(report.frame for report in self.reports)

    def save(self, path: str | Path) -> None:
        """Write everything but the pictures into one compressed .npz file, exactly at `path`."""
        header = {
            "arm_joints": self.arm_joints,
            "camera": _camera_document(self.camera),
            "prior": None if self.prior is None else _prior_document(self.prior),
            "meta": self.meta,
        }
        frames, estimates = self.frames, [report.estimate for report in self.reports]
        seen = [(k, marker) for k, frame in enumerate(frames) for marker in frame.markers]
        columns = (
            [frame.t_capture for frame in frames],
            [frame.t_receipt for frame in frames],
            np.reshape([frame.arm_position for frame in frames], (len(frames), len(self.arm_joints))),
            [report.ratio for report in self.reports],
            np.array([report.verdict.value if report.verdict else "" for report in self.reports], dtype=str),
            _stacked([e.T_world_object.homogeneous if e else None for e in estimates], (4, 4)),
            _stacked([e.covariance if e else None for e in estimates], (6, 6)),
            _stacked([e.twist_world if e else None for e in estimates], (6,)),
            np.array([k for k, _ in seen], dtype=int),
            np.array([marker.id for _, marker in seen], dtype=int),
            np.reshape([marker.corners for _, marker in seen], (len(seen), 4, 2)),
        )
        FORMAT.write(path, header, dict(zip(ARRAY_NAMES, map(np.asarray, columns), strict=True)))

    @classmethod
    def load(cls, path: str | Path) -> VisionRecord:
        """Read a record that `save` wrote, without its pictures; nothing in the file is executed.

        Raises:
            InputFileError: The file is missing, is no record of a camera, or lacks an array.
        """
        with FORMAT.opened(path) as (header, archive):
            arrays = {name: archive[name] for name in ARRAY_NAMES}
            prior = None if header["prior"] is None else _prior(header["prior"])
            names, camera, meta = tuple(header["arm_joints"]), _camera(header["camera"]), header["meta"]
        return cls(names, camera, prior, _reports(arrays), meta=meta)


def _reports(arrays: dict[str, Any]) -> tuple[FrameReport, ...]:
    a = arrays
    markers: list[list[MarkerCorners]] = [[] for _ in a["t_capture"]]
    for k, number, corners in zip(a["marker_frame"], a["marker_id"], a["marker_corners"], strict=True):
        markers[int(k)].append(MarkerCorners(int(number), corners))
    reports = []
    for k, found in enumerate(markers):
        t_receipt = float(a["t_receipt"][k])
        frame = Frame(float(a["t_capture"][k]), t_receipt, a["arm_position"][k], tuple(found))
        known = np.isfinite(a["T_world_object"][k]).all()
        T = pin.SE3(a["T_world_object"][k]) if known else None
        estimate = T and PoseEstimate(T, a["covariance"][k], t_receipt, t_receipt, a["twist_world"][k])
        verdict = str(a["verdict"][k])
        reports.append(FrameReport(frame, float(a["ratio"][k]), Verdict(verdict) if verdict else None, estimate))
    return tuple(reports)


def _stacked(items: list[Any], shape: tuple[int, ...]) -> Any:
    empty = np.full(shape, np.nan)
    return np.reshape([empty if item is None else item for item in items], (len(items), *shape))


def _prior_document(prior: PoseEstimate) -> dict[str, Any]:
    return {
        "T_world_object": prior.T_world_object.homogeneous.tolist(),
        "covariance": prior.covariance.tolist(),
        "twist_world": prior.twist_world.tolist(),
        "t": prior.t_capture,
    }


def _prior(document: dict[str, Any]) -> PoseEstimate:
    T, t = pin.SE3(np.array(document["T_world_object"])), float(document["t"])
    return PoseEstimate(T, np.array(document["covariance"]), t, t, np.array(document["twist_world"]))


def _camera_document(camera: CameraModel) -> dict[str, Any]:
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "focal": camera.focal.tolist(),
        "centre": camera.centre.tolist(),
        "distortion": camera.distortion.tolist(),
        "T_hand_camera": camera.T_hand_camera.homogeneous.tolist(),
        "rate": camera.rate,
        "exposure": camera.exposure,
    }


def _camera(document: dict[str, Any]) -> CameraModel:
    numbers = {name: np.array(document[name]) for name in ("focal", "centre", "distortion")}
    return CameraModel(
        name=document["name"],
        description="",
        width=int(document["width"]),
        height=int(document["height"]),
        **numbers,
        T_hand_camera=pin.SE3(np.array(document["T_hand_camera"])),
        rate=float(document["rate"]),
        exposure=float(document["exposure"]),
    )
