"""Where the corners of a part's markers are in a picture, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import MARKER_DICTIONARIES, GraspObject
from dyngrasp.signals import Array, read_only


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of `MarkerDetector`.

    Attributes:
        threshold_windows: Smallest, largest size and step of the adaptive threshold's window (pixels); each one costs a
            pass over the picture.
        smallest_share: Least perimeter of a marker as a share of the picture's longer side.
        refinement_window: Half size of the window in which a corner is refined (pixels), at most.
        refinement_share: The same as a share of the marker's module, which holds for small markers.
    """

    threshold_windows: tuple[int, int, int] = (13, 33, 20)
    smallest_share: float = 0.06
    refinement_window: int = 5
    refinement_share: float = 0.4

    def __post_init__(self) -> None:
        low, high, step = self.threshold_windows
        if not (3 <= low <= high and step >= 1):
            raise InvalidProblem(
                f"threshold_windows: 3 ≤ smallest ≤ largest and step ≥ 1, got {self.threshold_windows}"
            )
        if not 0.0 < self.smallest_share < 1.0 or self.refinement_window < 1 or not 0.0 < self.refinement_share <= 1.0:
            raise InvalidProblem(
                f"shares within (0, 1] and a window of at least 1 pixel expected, got {self.smallest_share}, "
                f"{self.refinement_share}, {self.refinement_window}"
            )


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
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = self.settings.refinement_window
        parameters.relativeCornerRefinmentWinSize = self.settings.refinement_share
        parameters.cornerRefinementMaxIterations = 30
        parameters.cornerRefinementMinAccuracy = 0.005
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
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        corners, ids, _ = self._detector.detectMarkers(grey)
        numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
        return tuple(
            sorted(
                (
                    MarkerCorners(number, np.asarray(found, dtype=float).reshape(4, 2))
                    for number, found in zip(numbers, corners, strict=True)
                    if number in self._ids and numbers.count(number) == 1
                ),
                key=lambda marker: marker.id,
            )
        )
