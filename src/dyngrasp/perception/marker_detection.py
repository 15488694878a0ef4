"""Where the corners of a part's markers are in a picture, to a fraction of a pixel.

Large pictures are searched at a reduced size, which takes a quarter of the time at half the size and finds the same
markers; corners are then refined in the picture itself, so that nothing is lost of their accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import MARKER_DICTIONARIES, GraspObject
from dyngrasp.signals import Array, read_only

# A refined corner has come to rest within this (pixels), or is as good as it gets after so many steps.
_REFINED = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 0.005)


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of `MarkerDetector`.

    Attributes:
        search_side: A picture whose longer side holds this n times is searched at an nth of its size (pixels).
        threshold_windows: Smallest, largest size and step of the adaptive threshold's window (pixels of the picture as
            it is searched); each one costs a pass over it.
        smallest_share: Least perimeter of a marker as a share of the picture's longer side.
        refinement_window: Half size of the window in which a corner is refined (pixels), at most.
        refinement_share: The same as a share of the marker's module, which holds for small markers.
    """

    search_side: int = 512
    threshold_windows: tuple[int, int, int] = (7, 17, 10)
    smallest_share: float = 0.06
    refinement_window: int = 5
    refinement_share: float = 0.4

    def __post_init__(self) -> None:
        low, high, step = self.threshold_windows
        if not (3 <= low <= high and step >= 1):
            raise InvalidProblem(
                f"threshold_windows: 3 ≤ smallest ≤ largest and step ≥ 1, got {self.threshold_windows}"
            )
        if self.search_side < 16:
            raise InvalidProblem(f"search_side: at least 16 pixels expected, got {self.search_side}")
        if not 0.0 < self.smallest_share < 1.0 or self.refinement_window < 1 or not 0.0 < self.refinement_share <= 1.0:
            raise InvalidProblem(
                f"shares within (0, 1] and a window of at least 1 pixel expected, got {self.smallest_share}, "
                f"{self.refinement_share}, {self.refinement_window}"
            )


# Blur rounds corners off, and the refinement puts them inside by this over the half size of its window (pixels):
# measured 0.18, 0.14 and 0.10 for 3, 4 and 5 on 9000 rendered markers between 0.25 and 0.6 m.
ROUNDED_OFF = 0.5


@dataclass(frozen=True, eq=False)
class MarkerCorners:
    """One marker in a picture.

    Attributes:
        id: Its number.
        corners: (4, 2) pixels, in the order upper left, upper right, lower right, lower left of the upright marker; the
            centre of the picture's first pixel is (0, 0).
    """

    id: int
    corners: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "corners", read_only(self.corners, (4, 2)))


class MarkerDetector:
    """Finds the markers of one part; others are ignored."""

    def __init__(self, part: GraspObject, settings: DetectionSettings | None = None) -> None:
        """Prepare.

        Args:
            part: Carries the markers.
            settings: Of the detection.

        Raises:
            InvalidProblem: The part has no markers, or one that its dictionary does not hold.
        """
        self.settings = settings or DetectionSettings()
        self._ids = frozenset(marker.id for marker in part.markers)
        if not self._ids:
            raise InvalidProblem(f"{part.name} carries no markers: its model.toml needs [[markers]] to be seen")
        family = getattr(cv2.aruco, MARKER_DICTIONARIES[part.marker_dictionary])
        dictionary = cv2.aruco.getPredefinedDictionary(family)
        size = len(dictionary.bytesList)
        if not self._ids <= set(range(size)):
            raise InvalidProblem(
                f"{part.name}: markers {sorted(self._ids)}; {part.marker_dictionary} holds 0 to {size - 1}"
            )
        parameters = cv2.aruco.DetectorParameters()
        low, high, step = self.settings.threshold_windows
        parameters.adaptiveThreshWinSizeMin = low
        parameters.adaptiveThreshWinSizeMax = high
        parameters.adaptiveThreshWinSizeStep = step
        parameters.minMarkerPerimeterRate = self.settings.smallest_share
        # Lines through the sides begin the refinement within a pixel: from the polygon's corners, two pixels of the
        # picture away where it is searched at half its size, a small marker's may end on the wrong edge.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        # Of a marker's side, the black border included.
        self._modules = dictionary.markerSize + 2
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(self, image: NDArray[np.uint8]) -> tuple[MarkerCorners, ...]:
        """The part's markers in a picture, by number.

        A number that is seen twice is left out: one of the two is something else, and nothing says which.

        Args:
            image: (height, width) or (height, width, 3, in the order red, green, blue) uint8.

        Raises:
            InvalidProblem: Not such an array.
        """
        image = np.asarray(image)
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise InvalidProblem(f"a picture of uint8, (h, w) or (h, w, 3), expected; got {image.dtype} {image.shape}")
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        factor = max(1, max(grey.shape) // self.settings.search_side)
        # Without a change of size this is a copy.
        searched = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        squares, ids, _ = self._detector.detectMarkers(searched)
        numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
        found = ((n, s) for n, s in zip(numbers, squares, strict=True) if n in self._ids and numbers.count(n) == 1)
        # Whole numbers are centres of pixels: edges of the picture, half a pixel away, are what scales.
        markers = (
            MarkerCorners(n, self._refine(grey, (s.reshape(4, 2).astype(float) + 0.5) * factor - 0.5)) for n, s in found
        )
        return tuple(sorted(markers, key=lambda marker: marker.id))

    def _refine(self, grey: NDArray[np.uint8], square: Array) -> Array:
        """(4, 2) corners where the grey values say they are, from a square that is about right."""
        s = self.settings
        side = float(np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1).mean())
        window = int(np.clip(round(s.refinement_share * side / self._modules), 1, s.refinement_window))
        found = np.array(square, dtype=np.float32, order="C")
        corners = cv2.cornerSubPix(grey, found, (window, window), (-1, -1), _REFINED).astype(float)
        outward = corners - corners.mean(axis=0)
        length = np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1.0)
        return corners + ROUNDED_OFF / window * outward / length


@contextmanager
def one_thread() -> Iterator[None]:
    """Detection uses no more than the calling thread: to measure it, or where others need the cores."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
