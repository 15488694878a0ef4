"""The camera's picture in the video: where it lies, which one it is, and what is drawn into it."""

import numpy as np
import pytest

from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.models.catalogue import load_camera
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.marker_drawing import outlined
from dyngrasp.perception.part_tracker import Frame, FrameReport
from dyngrasp.report.camera_inset import PATIENCE, CameraInset

CAMERA = load_camera("ava1000").scaled(640, 480)
SQUARE = np.array([[200.0, 100.0], [300.0, 100.0], [300.0, 200.0], [200.0, 200.0]])
WIDTH, HEIGHT = 960, 540


@pytest.fixture(scope="module")
def vision():
    """Three frames, of which the first and the last were kept: a dark and a bright picture."""
    reports = []
    for k in range(3):
        markers = (MarkerCorners(1, SQUARE),) if k else ()
        reports.append(FrameReport(Frame(0.1 * k, 0.1 * k + 0.013, np.zeros(7), markers), np.inf, None, None))
    pictures = {0: np.full((480, 640), 40, np.uint8), 2: np.full((480, 640), 200, np.uint8)}
    return VisionRecord(tuple(f"A{i}" for i in range(1, 8)), CAMERA, None, tuple(reports), pictures)


@pytest.fixture
def inset(vision):
    return CameraInset(vision, WIDTH)


BLANK = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)


def middle(frame):
    """Grey value in the middle of the picture in the frame, away from marker and border."""
    return int(frame[150, 60, 0])


def test_a_picture_shows_when_it_has_arrived_and_until_the_next(inset):
    assert inset.over(BLANK, 0.01) is BLANK
    assert middle(inset.over(BLANK, 0.02)) == 40
    assert middle(inset.over(BLANK, 0.21)) == 40
    assert middle(inset.over(BLANK, 0.22)) == 200
    assert inset.over(BLANK, 0.22 + PATIENCE) is BLANK
    assert (BLANK == 128).all()


def test_it_covers_the_upper_left_and_nothing_else(inset):
    changed = (inset.over(BLANK, 0.22) != BLANK).any(axis=2)
    rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
    assert 0 < rows[0] < 40
    assert 0 < columns[0] < 40
    # The arm's base begins farther down and to the right.
    assert rows[-1] < 0.55 * HEIGHT
    assert columns[-1] < WIDTH * 0.36


def test_a_video_that_is_too_flat_stays_as_it_is(inset):
    flat = BLANK[:100]
    assert inset.over(flat, 0.22) is flat


@pytest.mark.parametrize("width", [320, 640, 1280])
def test_outlines_lie_on_the_corners_at_any_size(width):
    picture = np.full((480, 640), 200, np.uint8)
    drawn = outlined(picture, [MarkerCorners(1, SQUARE)], width, (255, 0, 0))
    assert drawn.shape == (width * 3 // 4, width, 3)
    red = (drawn[..., 0].astype(int) - drawn[..., 2]) > 100
    scale = width / 640
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    # Two pixels of line, half of them outside, and one of smoothing.
    expected = (SQUARE.min(axis=0) + 0.5) * scale - 0.5, (SQUARE.max(axis=0) + 0.5) * scale - 0.5
    np.testing.assert_allclose([columns[0], rows[0]], expected[0], atol=2.0)
    np.testing.assert_allclose([columns[-1], rows[-1]], expected[1], atol=2.0)
    assert not red[rows[0] + 5 : rows[-1] - 4, columns[0] + 5 : columns[-1] - 4].any()
