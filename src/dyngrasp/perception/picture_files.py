"""Pictures in files, as the sensor has them: grey values, nothing lost, nothing turned."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dyngrasp.errors import InputFileError


def read_picture(path: str | Path) -> NDArray[np.uint8]:
    """A picture file as grey values; a note in the file on how to turn it for people is not followed.

    Args:
        path: PNG, JPEG or whatever else OpenCV reads.

    Returns:
        (height, width).

    Raises:
        InputFileError: No such file, or no picture.
    """
    try:
        data = np.frombuffer(Path(path).read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise InputFileError(path, None, None, f"cannot be read: {error.strerror or error}") from error
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    except cv2.error:  # a header that promises more pixels than OpenCV is willing to hold
        picture = None
    if picture is None:
        raise InputFileError(path, None, None, "is no picture that can be decoded: PNG or JPEG expected")
    return np.asarray(picture, dtype=np.uint8)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture as the contents of a PNG file."""
    return cv2.imencode(".png", picture)[1].tobytes()
