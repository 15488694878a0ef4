"""The part's markers as thin printed stickers on its faces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from dyngrasp.models.grasp_object import MARKER_DICTIONARIES
from dyngrasp.simulation.printed_sheet import PrintedSheet, add_sheet

if TYPE_CHECKING:
    from mujoco import MjSpec
    from mujoco._specs import MjsBody

    from dyngrasp.models.grasp_object import GraspObject

# So far above the face that the depth buffer tells them apart (m), and so little that no pose shows it.
RISE = 1e-4

# Edge of one module of the pattern in the texture: corners stay sharp where the camera is near.
MODULE_PIXELS = 48

# Width of the white margin in modules: the detector finds the black border by it.
QUIET_MODULES = 0.75


def add_stickers(spec: MjSpec, body: MjsBody, part: GraspObject) -> None:
    """Stick all markers of a part on the body that stands for it.

    Args:
        spec: The world.
        body: Its body frame is the object frame.
        part: Carries the markers.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARIES[part.marker_dictionary]))
    inner = (dictionary.markerSize + 2) * MODULE_PIXELS
    margin = round(QUIET_MODULES * MODULE_PIXELS)
    for marker in part.markers:
        pattern = cv2.aruco.generateImageMarker(dictionary, marker.id, inner)
        picture = np.pad(pattern, margin, constant_values=255).astype(np.uint8)
        width = marker.size * len(picture) / inner
        add_sheet(spec, body, PrintedSheet(f"marker_{marker.id}", picture, width, RISE, marker.T_object_marker))
