"""Errors of corners: what is put in comes out again."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.experiments.corner_errors import CHANGES, SeenSquare, describe
from dyngrasp.perception.pose_track import view_change

OUTWARDS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / np.sqrt(2)


def film(rng, share, decay, outwards=0.0, pictures=40, step=0.05):
    """Errors of 0.1 pixels an axis, of which a share repeats and is forgotten over `decay` of turn."""
    squares, repeating = [], rng.normal(size=(4, 2))
    for k in range(pictures):
        T = pin.SE3(pin.exp3(np.array([0.0, 0.0, k * step])), np.array([0.0, 0.0, 0.4]))
        if k:
            kept = np.exp(-view_change(squares[-1].T_camera_object, T) / decay)
            repeating = kept * repeating + np.sqrt(1 - kept**2) * rng.normal(size=(4, 2))
        white = rng.normal(size=(4, 2))
        errors = 0.1 * (np.sqrt(share) * repeating + np.sqrt(1 - share) * white) + outwards * OUTWARDS
        squares.append(SeenSquare(T, errors, OUTWARDS))
    return squares


def test_the_share_that_repeats_and_how_it_is_forgotten_are_found():
    rng = np.random.default_rng(0)
    size, *classes = describe([film(rng, share=0.8, decay=0.5) for _ in range(150)])
    assert size["squares"] == 150 * 40
    assert size["rms_px"] == pytest.approx(0.1, rel=0.05)
    # All squares of a film have errors in common: 150 of them leave 0.004 of the mean over four corners.
    assert abs(size["outwards_px"]) < 0.012
    assert size["astray_percent"] == 0.0
    # Changes of 0.05 n within each class.
    for row, low, high in zip(classes, CHANGES[:-1], CHANGES[1:], strict=True):
        changes = [0.05 * n for n in range(1, 40) if low <= 0.05 * n + 1e-9 < high]
        expected = [0.8 * np.exp(-change / 0.5) for change in changes]
        if expected:
            assert min(expected) - 0.08 < row["correlation"] < max(expected) + 0.08


def test_squares_that_are_seen_too_small_and_corners_behind_something_are_told():
    rng = np.random.default_rng(1)
    squares = [film(rng, share=0.0, decay=1.0, outwards=-0.2) for _ in range(10)]
    errors = squares[0][0].errors.copy()
    errors[2, 0] += 3.0
    squares[0][0] = SeenSquare(squares[0][0].T_camera_object, errors, OUTWARDS)
    size, *_ = describe(squares)
    assert size["outwards_px"] == pytest.approx(-0.2, abs=0.01)
    assert size["outwards_deviation_px"] == pytest.approx(0.05, rel=0.2)
    assert size["astray_percent"] == pytest.approx(100 / 400)
