"""Lens and mount from rendered pictures of a board, against the camera that took them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.cli import main
from dyngrasp.errors import RenderingUnavailable
from dyngrasp.experiments.camera_calibration import lens_difference, lens_from_folder, mount_difference
from dyngrasp.experiments.filmed_board import PLACE, THICKNESS, TRUTH, film_board, mounted_by_hand, write_board_film
from dyngrasp.models.catalogue import load_camera
from dyngrasp.perception.calibration import Board, calibrate_hand_eye, calibrate_lens, find_board
from dyngrasp.perception.picture_folder import read_postures

BOARD = Board()

# What is required of the command: root mean square of the reprojection, and the mount's error.
PIXELS, METRES, RADIANS = 0.3, 1e-3, np.deg2rad(0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Small pictures, as few as a lens can be found from with some to spare."""
    path = tmp_path_factory.mktemp("board") / "pictures"
    try:
        write_board_film(path, load_camera("ava1000").scaled(640, 480), BOARD, 16, seed=3)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    return path


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Run `dyngrasp calibrate …`; its exit status and what it printed on one line."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        status = main(["calibrate", *map(str, arguments)])
        captured = capsys.readouterr()
        return status, " ".join((captured.out + captured.err).split())

    return run


def test_a_whole_session_finds_the_camera(folder, run):
    start, truth = load_camera("ava1000").scaled(640, 480), load_camera(folder / TRUTH)
    # There is something to find: more than the bounds below allow, many times over.
    before = mount_difference(start, truth)
    assert before[0] > 3 * METRES
    assert before[1] > 5 * RADIANS
    status, words = run("camera", folder, "--size", "640", "480", "--out", "lens.toml", "--against", folder / TRUTH)
    assert status == 0, words
    assert "16 of 16 views used" in words
    lens = load_camera("lens.toml")
    status, words = run("handeye", folder, "--camera", "lens.toml", "--out", "camera.toml")
    assert status == 0, words
    assert "written to camera.toml" in words
    found = load_camera("camera.toml")
    moved, turned = mount_difference(found, truth)
    assert moved < METRES
    assert turned < RADIANS
    # The second step leaves the lens alone, the first one the mount.
    for name in ("focal", "centre", "distortion", "width", "height", "rate", "exposure", "name"):
        np.testing.assert_array_equal(getattr(found, name), getattr(lens, name))
    np.testing.assert_allclose(lens.T_hand_camera.homogeneous, start.T_hand_camera.homogeneous, atol=1e-12)
    # Towards the edge, where few corners are, a fit of 16 small pictures is worth a pixel; the start was worse.
    assert lens_difference(lens, truth) < min(1.5, 0.5 * lens_difference(start, truth) + 0.5)

    # Neither step writes over a file.
    written = {name: Path(name).read_text() for name in ("lens.toml", "camera.toml")}
    for arguments in (
        ("camera", folder, "--size", "640", "480", "--out", "lens.toml"),
        ("handeye", folder, "--camera", "lens.toml", "--out", "camera.toml"),
        ("render", folder),
    ):
        status, words = run(*arguments)
        assert status == 2
        assert "cannot be written" in words
    assert {name: Path(name).read_text() for name in written} == written


def test_the_postures_are_those_of_the_pictures(folder, robot, gripper):
    """The true camera at the noted angles sees the board's corners where they are found."""
    truth = load_camera(folder / TRUTH)
    half = 0.5 * BOARD.square * np.array([BOARD.columns, BOARD.rows])
    corner = PLACE + np.array([-half[0], half[1], THICKNESS])
    T_world_board = pin.SE3(np.diag([1.0, -1.0, -1.0]), corner)
    found = lens_from_folder(folder, BOARD, load_camera("ava1000").scaled(640, 480))
    postures = dict(read_postures(folder, robot.joint_names))
    offsets = []
    for picture in found.pictures:
        T_world_camera = robot.forward_kinematics(postures[picture.path]) * gripper.T_flange_hand * truth.T_hand_camera
        T = T_world_camera.actInv(T_world_board)
        ideal = truth.project(BOARD.corners[picture.view.ids] @ T.rotation.T + T.translation)[0]
        offsets.append(picture.view.pixels - ideal)
    offsets = np.concatenate(offsets)
    # A board, a sheet or a frustum off by 0.1 mm would shift all corners by 0.15 pixels.
    assert np.abs(offsets.mean(axis=0)).max() < 0.05
    assert np.sqrt(np.mean(offsets**2)) < 0.15


def test_a_swapped_row_stands_out(folder, run, tmp_path):
    """Two pictures whose names changed places in the table are named; all others fit."""
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in folder.iterdir():
        text = path.read_bytes()
        if path.name == "frames.csv":
            text = text.replace(b"0004.png", b"x").replace(b"0011.png", b"0004.png").replace(b"x", b"0011.png")
        (copy / path.name).write_bytes(text)
    status, words = run("handeye", copy, "--camera", copy / TRUTH, "--out", "camera.toml")
    assert status == 1
    assert "not calibrated" in words
    assert "is more than detection explains" in words
    assert "0011.png, 0004.png: blurred, or the row of another picture" in words


@pytest.mark.slow
def test_the_mount_from_corners_with_a_fifth_of_a_pixel_of_noise(robot, gripper):
    """Full pictures, and noise of 0.2 pixels on each coordinate of each corner in addition to the pictures' own."""
    nominal = load_camera("ava1000")
    for seed in range(2):
        true = mounted_by_hand(nominal, seed)
        try:
            film = list(film_board(true, BOARD, 30, seed))
        except RenderingUnavailable as error:
            pytest.skip(str(error))
        seen = [(find_board(view.picture, BOARD), view.arm_position) for view in film]
        seen = [(view, q) for view, q in seen if view.shortcoming(BOARD) is None]
        assert len(seen) >= 25
        clean = calibrate_lens([view for view, _ in seen], BOARD, nominal)
        assert clean.error < 0.1  # of rendered pictures as they are
        rng = np.random.default_rng(seed)
        views = [replace(view, pixels=view.pixels + rng.normal(0.0, 0.2, view.pixels.shape)) for view, _ in seen]
        hands = [robot.forward_kinematics(q) * gripper.T_flange_hand for _, q in seen]
        lens = calibrate_lens(views, BOARD, nominal)
        # 0.2 on each axis is 0.283 long.
        assert 0.25 < lens.error < PIXELS
        # With a lens that is known; and with the one found from these noisy corners: there the centre is open by more
        # than a pixel, and the camera's turn, which looks the same, by 0.06° about each of two axes.
        for camera, turn in ((true, 0.2 * RADIANS), (lens.camera, 2.5 * RADIANS)):
            mount = calibrate_hand_eye(views, hands, BOARD, camera)
            assert mount.error < PIXELS
            e = pin.log6(mount.T_hand_camera.actInv(true.T_hand_camera)).vector
            assert np.linalg.norm(e[:3]) < METRES
            assert np.linalg.norm(e[3:]) < turn
            # What it says of itself: six numbers, four deviations.
            share = e / np.hypot(mount.deviation, mount.lens_deviation)
            assert np.abs(share).max() < 4.0
