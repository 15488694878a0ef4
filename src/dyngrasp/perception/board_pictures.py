"""The calibration board drawn: as a picture for a renderer, in its true size for a printer."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dyngrasp.models.grasp_object import MARKER_DICTIONARIES
from dyngrasp.perception.calibration import Board

# White around the squares (m): the outer black squares need an edge, and a hand something to hold.
MARGIN = 0.012


def board_picture(board: Board, square_pixels: int = 240) -> NDArray[np.uint8]:
    """The board with its margin, for the renderer.

    Args:
        board: What to draw.
        square_pixels: Edge of a square.

    Returns:
        Grey values; the first row is the upper edge.
    """
    size = (board.columns * square_pixels, board.rows * square_pixels)
    inner = np.asarray(board.opencv().generateImage(size, marginSize=0), dtype=np.uint8)
    return np.pad(inner, round(MARGIN / board.square * square_pixels), constant_values=255)


def board_svg(board: Board) -> str:
    """The board in its true size, for the printer, with its measures below."""
    mm = 1e3
    squares = [
        _path(x * board.square, y * board.square, board.square)
        for y in range(board.rows)
        for x in range(board.columns)
        if (x + y) % 2 == 0
    ]
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARIES[board.dictionary]))
    modules = dictionary.markerSize + 2
    module = board.marker / modules
    drawn = board.opencv()
    for number, corners in zip(np.ravel(drawn.getIds()), drawn.getObjPoints(), strict=True):
        left, top = np.asarray(corners)[0][:2]
        pattern = cv2.aruco.generateImageMarker(dictionary, int(number), modules)
        for row, column in np.argwhere(np.asarray(pattern) < 128):
            squares.append(_path(left + column * module, top + row * module, module))
    width, height = board.columns * board.square + 2 * MARGIN, board.rows * board.square + 2 * MARGIN
    words = (
        f"{board.columns} × {board.rows} squares of {mm * board.square:g} mm, markers of {mm * board.marker:g} mm, "
        f"{board.dictionary}. Printed right, all squares together are {mm * board.columns * board.square:g} mm wide."
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{mm * width:g}mm" height="{mm * height:g}mm" '
        f'viewBox="{-mm * MARGIN:g} {-mm * MARGIN:g} {mm * width:g} {mm * height:g}">\n'
        f'<rect x="{-mm * MARGIN:g}" y="{-mm * MARGIN:g}" width="{mm * width:g}" height="{mm * height:g}" '
        'fill="white"/>\n'
        f'<path d="{" ".join(squares)}"/>\n'
        f'<text x="0" y="{mm * (board.rows * board.square + 0.6 * MARGIN):g}" font-family="sans-serif" '
        f'font-size="{0.3 * mm * MARGIN:g}">{words}</text>\n'
        "</svg>\n"
    )


def _path(x: float, y: float, edge: float) -> str:
    """A black square of a path, lengths in mm."""
    x, y, edge = (round(1e3 * float(value), 6) for value in (x, y, edge))
    return f"M{x:g} {y:g}h{edge:g}v{edge:g}h{-edge:g}z"
