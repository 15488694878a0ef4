"""Detected markers drawn into the picture that they were found in, for people."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from dyngrasp.perception.marker_detection import MarkerCorners

# OpenCV takes whole numbers; this many binary digits of them count as fractions.
_FRACTION = 4


def outlined(
    picture: NDArray[np.uint8],
    markers: Iterable[MarkerCorners],
    width: int,
    colour: tuple[int, int, int],
    line: int = 2,
) -> NDArray[np.uint8]:
    """A picture of another size with the outlines of markers.

    Args:
        picture: (h, w) grey values.
        markers: Corners in pixels of that picture.
        width: Of the result (pixels); its height keeps the shape.
        colour: Of the outlines, red, green, blue.
        line: Their thickness (pixels).

    Returns:
        (height, width, 3) red, green, blue.
    """
    scale = width / picture.shape[1]
    size = (width, round(scale * picture.shape[0]))
    shrunk = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    result = cv2.cvtColor(shrunk, cv2.COLOR_GRAY2RGB)
    for marker in markers:
        # The centre of the first pixel is (0, 0) in both: edges scale, centres do not.
        corners = (marker.corners + 0.5) * scale - 0.5
        points = np.round(corners * 2**_FRACTION).astype(np.int32)
        cv2.polylines(result, [points], True, colour, line, cv2.LINE_AA, _FRACTION)
    return np.asarray(result, dtype=np.uint8)
