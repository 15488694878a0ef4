"""The camera's equations against OpenCV and finite differences, and files that are refused."""

from dataclasses import replace

import cv2
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import ModelFileError, UnknownName
from dyngrasp.models.camera import camera_toml, picture_border, read_camera
from dyngrasp.models.catalogue import CAMERAS, catalogue, check_model, load_camera


@pytest.fixture(scope="module")
def camera():
    return load_camera("ava1000")


@pytest.fixture(scope="module")
def points():
    random = np.random.default_rng(3)
    return random.uniform([-0.1, -0.1, 0.25], [0.1, 0.1, 0.7], (60, 3))


def test_projects_as_opencv_does(camera, points):
    pixels, _ = camera.project(points)
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    # Two evaluations of one polynomial: rounding only.
    np.testing.assert_allclose(pixels, theirs[:, 0], atol=1e-9)


def test_derivatives_are_those_of_the_projection(camera, points):
    _, jacobian = camera.project(points)
    step = 1e-6
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        slope = (camera.project(points + shift)[0] - camera.project(points - shift)[0]) / (2 * step)
        # Central differences of pixels of order 1e3 with a step of 1e-6: rounding leaves 1e-13·1e3/1e-6 = 1e-4.
        np.testing.assert_allclose(jacobian[:, :, axis], slope, atol=1e-3, rtol=1e-6)


def test_undistortion_inverts_the_lens_over_the_whole_picture(camera):
    grid = np.stack(np.meshgrid(np.linspace(0, 1023, 40), np.linspace(0, 1023, 40)), axis=-1).reshape(-1, 2)
    rays = camera.undistort(grid)
    back, _ = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(back, grid, atol=1e-6)
    # The lens is not a pinhole: ignoring it would be seen.
    ideal = rays * camera.focal + camera.centre
    assert np.linalg.norm(ideal - grid, axis=1).max() > 10.0


def test_behind_the_camera_nothing_is_seen(camera):
    pixels, jacobian = camera.project([[0.0, 0.0, -0.3], [0.0, 0.0, 0.0], [0.0, 0.0, 0.3]])
    assert np.isnan(pixels[:2]).all()
    assert np.isnan(jacobian[:2, :, 2]).all()
    assert np.isfinite(pixels[2]).all()


@pytest.mark.parametrize(("width", "height"), [(640, 480), (512, 512), (2048, 1024)])
def test_scaled_pictures_show_the_same_directions(camera, width, height):
    other = camera.scaled(width, height)
    factor = max(width, height) / 1024
    middle, _ = camera.project([[0.0, 0.0, 1.0]])
    scaled_middle, _ = other.project([[0.0, 0.0, 1.0]])
    # A picture's left and right edge, in the same directions before and after.
    np.testing.assert_allclose(
        (scaled_middle + 0.5 - [width / 2, height / 2]) / factor, middle + 0.5 - 512.0, atol=1e-9
    )
    np.testing.assert_allclose(other.focal, camera.focal * factor)
    longer = int(height > width)
    edge = np.full((1, 2), 511.5)
    edge[0, longer] = -0.5
    scaled_edge = np.array([[width / 2 - 0.5, height / 2 - 0.5]])
    scaled_edge[0, longer] = -0.5
    np.testing.assert_allclose(other.undistort(scaled_edge), camera.undistort(edge), atol=1e-9)


def test_sizes_of_nothing_are_refused(camera):
    with pytest.raises(ValueError, match="at least 1"):
        camera.scaled(0, 480)


def test_the_catalogue_knows_it(camera):
    assert camera.name == "ava1000"
    assert ("camera", "ava1000") in {(row.kind, row.name) for row in catalogue()}
    facts = "\n".join(check_model(CAMERAS["ava1000"]))
    assert "sees 38.8 x 38.8 deg" in facts
    with pytest.raises(UnknownName, match="ava1000"):
        load_camera("nosuch")


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("width = 1024", "width = 0", "sensor.width"),
        ("exposure_s = 0.002", "exposure_s = 0.05", "sensor.exposure_s"),
        ("fx = 1454.5", "fx = -1454.5", "intrinsics.fx"),
        ("cx = 511.5", "cx = 2000.0", "intrinsics.cx"),
        ("cy = 511.5", "cy = nan", "intrinsics.cy"),
        ("[-0.095, 0.06,", "[-3.0, 0.06,", "intrinsics.distortion"),
        ("quat_wxyz = [1.0, 0.0", "quat_wxyz = [0.9, 0.0", "mount.quat_wxyz"),
        ("rate_hz", "rate", "sensor.rate"),
    ],
)
def test_bad_files_are_refused_by_key(tmp_path, old, new, key):
    text = (CAMERAS["ava1000"] / "model.toml").read_text()
    assert old in text
    path = tmp_path / "model.toml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ModelFileError) as caught:
        read_camera(path)
    assert caught.value.key == key
    assert str(path) in str(caught.value)


def test_border_encloses_the_picture(camera):
    border = picture_border(camera)
    assert border.min() == -0.5
    assert border.max() == 1023.5


def test_a_camera_that_is_written_is_the_one_that_is_read(camera, tmp_path):
    random = np.random.default_rng(5)
    other = replace(
        camera,
        name='the "left" one',
        description="lens of 8 mm\\½",
        focal=camera.focal + random.normal(0, 10, 2),
        centre=camera.centre + random.normal(0, 10, 2),
        distortion=camera.distortion + random.normal(0, 1e-3, 5),
        T_hand_camera=pin.SE3.Random(),
    )
    path = tmp_path / "model.toml"
    path.write_text(camera_toml(other, ("found today",)), encoding="utf-8")
    assert path.read_text(encoding="utf-8").startswith("# found today\n")
    found = read_camera(path)
    for name in ("name", "description", "width", "height", "rate", "exposure"):
        assert getattr(found, name) == getattr(other, name)
    for name in ("focal", "centre", "distortion"):
        np.testing.assert_array_equal(getattr(found, name), getattr(other, name))
    # By way of a quaternion: rounding.
    np.testing.assert_allclose(found.T_hand_camera.homogeneous, other.T_hand_camera.homogeneous, atol=1e-14)
