"""The drawn board: the printer's, the renderer's and OpenCV's are one."""

import re

import cv2
import numpy as np
import pytest

from dyngrasp.perception.board_pictures import MARGIN, board_picture, board_svg
from dyngrasp.perception.calibration import Board, find_board

SCALE = 4  # pixels a millimetre


def between(before, after, svg):
    return svg.split(before, 1)[1].split(after, 1)[0]


def painted(svg):
    """The rectangles of the drawing's path, painted; the path holds nothing else."""
    left, top, width, height = map(float, between('viewBox="', '"', svg).split())
    picture = np.full((round(SCALE * height), round(SCALE * width)), 255, np.uint8)
    path = between('<path d="', '"', svg)
    squares = re.findall(r"M(\S+) (\S+?)h(\S+?)v(\S+?)h-(\S+?)z", path)
    assert len(squares) == path.count("M")
    for square in squares:
        x, y, *edges = map(float, square)
        assert edges == [edges[0]] * 3
        low = np.array([x - left, y - top])
        (x0, y0), (x1, y1) = np.round(SCALE * low).astype(int), np.round(SCALE * (low + edges[0])).astype(int)
        picture[y0:y1, x0:x1] = 0
    return picture


@pytest.mark.parametrize("board", [Board(), Board(7, 5, 0.028, 0.021, "4x4_50")])
def test_the_printed_board_is_the_rendered_one(board):
    svg = board_svg(board)
    drawn = board_picture(board, round(1e3 * SCALE * board.square))
    on_paper = painted(svg)
    assert on_paper.shape == drawn.shape
    # Modules of a marker are no whole number of pixels in either: their edges may differ by one.
    assert np.mean(on_paper != drawn) < 0.02
    unlike = cv2.morphologyEx((on_paper != drawn).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    assert not unlike.any()
    width = float(between('width="', "mm", svg))
    assert width == pytest.approx(1e3 * (board.columns * board.square + 2 * MARGIN))
    # And it is what the detector knows: corners where the squares meet.
    view = find_board(on_paper, board)
    assert len(view.ids) == len(board.corners)
    ideal = 1e3 * SCALE * (board.corners[view.ids, :2] + MARGIN) - 0.5
    np.testing.assert_allclose(view.pixels, ideal, atol=0.3)
