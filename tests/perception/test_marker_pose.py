"""Markers found in drawn pictures, and poses from their corners, against the poses they were drawn from."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.stats import chi2

from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.marker_detection import DetectionSettings, MarkerCorners, MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSettings, MarkerPoseSolver, corners_in_object

from .conftest import looking_down


@pytest.fixture(scope="module")
def detector(casting):
    return MarkerDetector(casting)


@pytest.fixture(scope="module")
def solver(camera, casting):
    return MarkerPoseSolver(camera, casting)


def exact(camera, casting, T, ids=(0, 1, 2)):
    """The corners that an ideal detector would find."""
    markers = {marker.id: marker for marker in casting.markers}
    return [
        MarkerCorners(i, camera.project(corners_in_object(markers[i]) @ T.rotation.T + T.translation)[0]) for i in ids
    ]


def error(found: pin.SE3, true: pin.SE3) -> np.ndarray:
    """δ of true = found · exp(δ), as covariances mean it."""
    return pin.log6(found.actInv(true)).vector


def views(count, seed=0, tilt=0.6):
    random = np.random.default_rng(seed)
    for _ in range(count):
        yield looking_down(
            random.uniform(0.25, 0.6), random.uniform(0, tilt), random.uniform(-np.pi, np.pi), random.uniform(0, 6.28)
        )


def test_poses_from_pictures(detector, solver, casting, camera, draw):
    corner, errors, normalised = [], [], []
    for k, T in enumerate(views(40)):
        found = detector.detect(draw(T, seed=k))
        for mine, true in zip(found, exact(camera, casting, T, [m.id for m in found]), strict=True):
            if mine.id <= 2:  # those that face the camera; the others are seen at a grazing angle
                corner.append(mine.corners - true.corners)
        best = solver.solve(found).candidates[0]
        assert best.markers == tuple(m.id for m in found)
        e = error(best.T_camera_object, T)
        errors.append([np.linalg.norm(e[:3]), np.linalg.norm(e[3:])])
        normalised.append(e @ np.linalg.solve(best.covariance, e))
    # Lines of pixels drawn by a homography: a picture's blur and noise come on top.
    assert np.sqrt(np.mean(np.square(corner))) < 0.2
    # With 0.2 px at f = 909 px and markers 0.1 m apart: 0.1 mm across, 1 mm along the view at 0.6 m, 0.5°.
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[0] < 1.0e-3
    assert rms[1] < np.deg2rad(0.5)
    # The promised noise is an upper bound, so the covariance may be too large, not too small.
    assert np.mean(normalised) < chi2.ppf(0.975, 6 * 40) / 40


def test_covariance_is_that_of_least_squares(solver, camera, casting):
    T = looking_down(0.4, tilt=0.3, yaw=0.5)
    found = exact(camera, casting, T)
    candidate = solver.solve(found).candidates[0]
    np.testing.assert_allclose(error(candidate.T_camera_object, T), 0.0, atol=1e-7)
    step = 1e-6
    columns = []
    for axis in range(6):
        ends = [exact(camera, casting, T * pin.exp6(sign * step * np.eye(6)[axis])) for sign in (1, -1)]
        plus, minus = (np.vstack([marker.corners for marker in end]).ravel() for end in ends)
        columns.append((plus - minus) / (2 * step))
    sides = [np.linalg.norm(m.corners - np.roll(m.corners, 1, axis=0), axis=1) for m in found]
    weight = np.repeat([s.min() / s.max() for s in sides], 8)
    J = weight[:, None] * np.column_stack(columns)
    # Differences of pixels with a step of 1e-6 leave 1e-7 relative; the inverse multiplies that by its condition.
    variance = MarkerPoseSettings().corner_noise ** 2
    np.testing.assert_allclose(candidate.covariance, variance * np.linalg.inv(J.T @ J), rtol=1e-3, atol=1e-12)


def test_errors_are_as_large_as_the_covariance_says(camera, casting):
    # Without foreshortening weights and residual scaling noise of the assumed size must fit exactly.
    solver = MarkerPoseSolver(camera, casting, MarkerPoseSettings(corner_noise=0.3))
    random = np.random.default_rng(5)
    runs, sums = 300, 0.0
    for T in views(runs, seed=6, tilt=0.3):
        noisy = []
        for marker in exact(camera, casting, T):
            sides = np.linalg.norm(marker.corners - np.roll(marker.corners, 1, axis=0), axis=1)
            sigma = 0.3 * sides.max() / sides.min()
            noisy.append(MarkerCorners(marker.id, marker.corners + random.normal(0.0, sigma, (4, 2))))
        best = solver.solve(noisy).candidates[0]
        e = error(best.T_camera_object, T)
        sums += e @ np.linalg.solve(best.covariance, e)
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
    # Residuals above their expectation enlarge the covariance of about half of the views by some 15 %, hence the slack.
    assert 0.85 * low < sums / runs < high


def test_one_marker_from_the_front_has_two_poses(solver, camera, casting, draw, detector):
    T = looking_down(0.9, tilt=0.1, turn=0.7)
    sighting = solver.solve(detector.detect(draw(T, only=(2,))))
    assert sighting.seen == (2,)
    assert sighting.ambiguous
    assert len(sighting.candidates) == 2
    right, wrong = sorted(sighting.candidates, key=lambda c: np.linalg.norm(error(c.T_camera_object, T)[3:]))
    assert np.linalg.norm(error(right.T_camera_object, T)[3:]) < np.deg2rad(6)
    # The mirrored tilt: twice 0.05 rad is 5.7°.
    assert np.linalg.norm(error(wrong.T_camera_object, T)[3:]) > np.deg2rad(4)
    # Three markers decide what one could not.
    all_seen = solver.solve(detector.detect(draw(T)))
    assert not all_seen.ambiguous
    assert all_seen.plausible == all_seen.candidates[:1]
    assert sighting.plausible == sighting.candidates
    assert np.linalg.norm(error(all_seen.candidates[0].T_camera_object, T)[3:]) < np.deg2rad(1)


def test_a_marker_at_the_wrong_place_is_left_out(solver, camera, casting):
    T = looking_down(0.4, tilt=0.3)
    found = exact(camera, casting, T)
    found[1] = MarkerCorners(1, found[1].corners + np.array([40.0, 25.0]))
    sighting = solver.solve(found)
    assert sighting.seen == (0, 1, 2)
    assert sighting.candidates[0].markers == (0, 2)
    assert np.linalg.norm(error(sighting.candidates[0].T_camera_object, T)) < 1e-6


def test_nothing_to_see(solver, detector, camera, casting):
    assert detector.detect(np.full((480, 640), 90, np.uint8)) == ()
    assert solver.solve(()).candidates == ()
    nan = MarkerCorners(0, np.full((4, 2), np.nan))
    assert solver.solve([nan]).candidates == ()
    bent = MarkerCorners(0, np.array([[10.0, 10.0], [300.0, 40.0], [90.0, 400.0], [20.0, 95.0]]))
    assert solver.solve([bent]).candidates == ()


def test_a_number_seen_twice_is_no_marker(detector, draw):
    picture = draw(looking_down(0.45), only=(2,))
    ids = [marker.id for marker in detector.detect(picture)]
    assert ids == [2]
    twice = np.vstack([picture, picture])
    assert detector.detect(twice) == ()


def test_a_search_at_half_the_size_finds_the_same_corners(casting, camera, draw, detector):
    half = MarkerDetector(casting, DetectionSettings(search_side=320))
    errors: list[list[np.ndarray]] = [[], []]
    for T in views(12, seed=5):
        T = pin.SE3(T.rotation, T.translation * 0.3 / T.translation[2])
        picture = draw(T)
        for side, found in zip(errors, (half.detect(picture), detector.detect(picture)), strict=True):
            truth = exact(camera, casting, T, range(5))
            side.append(np.full((5, 4), np.nan))
            for marker in found:
                side[-1][marker.id] = np.linalg.norm(marker.corners - truth[marker.id].corners, axis=1)
    halved, whole = np.array(errors)
    both = np.isfinite(halved) & np.isfinite(whole)
    # A marker seen from the side may be too narrow for the smaller picture.
    assert both.sum() > 0.95 * np.isfinite(whole).sum() > 60
    # What is found is where the refinement ends, but for single corners of such markers.
    assert np.mean(np.abs(halved - whole)[both] > 0.02) < 0.1
    assert np.sqrt(np.mean(halved[both] ** 2)) < 1.1 * np.sqrt(np.mean(whole[both] ** 2))


def test_colour_pictures_are_read_as_grey(detector, draw):
    picture = draw(looking_down(0.45, tilt=0.2))
    grey, colour = detector.detect(picture), detector.detect(np.repeat(picture[..., None], 3, axis=2))
    for a, b in zip(grey, colour, strict=True):
        assert a.id == b.id
        np.testing.assert_allclose(a.corners, b.corners, atol=0.02)


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 4, 4), np.uint8), np.zeros((10, 10)), np.zeros(10, np.uint8)], ids=["rgba", "float", "row"]
)
def test_other_arrays_are_refused(detector, picture):
    with pytest.raises(InvalidProblem, match="uint8"):
        detector.detect(picture)


def test_parts_that_cannot_be_seen_are_refused(casting):
    with pytest.raises(InvalidProblem, match="no markers"):
        MarkerDetector(replace(casting, markers=()))
    foreign = replace(casting.markers[0], id=77)
    with pytest.raises(InvalidProblem, match="0 to 49"):
        MarkerDetector(replace(casting, markers=(foreign,)))


@pytest.mark.parametrize("settings", [{"corner_noise": 0.0}, {"agreement": np.nan}, {"clear_ratio": 0.5}, {"steps": 0}])
def test_impossible_settings_of_the_solver_are_refused(settings):
    with pytest.raises(InvalidProblem):
        MarkerPoseSettings(**settings)


@pytest.mark.parametrize("settings", [{"threshold_windows": (1, 5, 2)}, {"smallest_share": 0.0}, {"search_side": 0}])
def test_impossible_settings_of_the_detector_are_refused(settings):
    with pytest.raises(InvalidProblem):
        DetectionSettings(**settings)
