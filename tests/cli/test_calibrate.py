"""`dyngrasp calibrate` without a renderer: mistakes of a user, and a folder of drawn pictures that is good."""

import csv
from dataclasses import replace

import cv2
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.cli import main
from dyngrasp.cli.arguments import BAD_INPUT, DELIVERED, DICTIONARIES
from dyngrasp.models.camera import camera_toml
from dyngrasp.models.catalogue import load_camera, load_gripper, load_robot
from dyngrasp.models.grasp_object import MARKER_DICTIONARIES
from dyngrasp.perception.calibration import Board
from dyngrasp.perception.picture_files import png, read_picture

BOARD = Board()
POSTURE = np.deg2rad([0.0, 25.0, 0.0, -90.0, 0.0, 65.0, 0.0])
MIDDLE = BOARD.corners.mean(axis=0)


@pytest.fixture(scope="module")
def camera():
    """A pinhole: pictures of a plane are then homographies, which OpenCV draws."""
    return replace(load_camera("ava1000").scaled(640, 480), name="pinhole", distortion=np.zeros(5))


def drawn(camera, T_camera_board):
    """The board as the camera sees it."""
    scale = 40
    board = BOARD.opencv().generateImage((BOARD.columns * scale, BOARD.rows * scale), marginSize=0)
    outline = np.array([[0, 0], [BOARD.columns, 0], [BOARD.columns, BOARD.rows], [0, BOARD.rows]], dtype=float)
    points = np.column_stack([outline * BOARD.square, np.zeros(4)])
    pixels = camera.project(points @ T_camera_board.rotation.T + T_camera_board.translation)[0]
    transform = cv2.getPerspectiveTransform((outline * scale - 0.5).astype(np.float32), pixels.astype(np.float32))
    size = (camera.width, camera.height)
    # Smoothed before it shrinks: a warp alone would leave edges to chance.
    board = cv2.GaussianBlur(board, (0, 0), 0.6)
    return np.asarray(cv2.warpPerspective(board, transform, size, borderValue=200), dtype=np.uint8)


@pytest.fixture(scope="module")
def originals(camera, tmp_path_factory):
    """Ten pictures from an arm that stands still in ten postures, with their table, and the camera's file."""
    folder = tmp_path_factory.mktemp("originals")
    robot, gripper = load_robot("iiwa14"), load_gripper("sdh2")
    T_flange_camera = gripper.T_flange_hand * camera.T_hand_camera
    aim = robot.forward_kinematics(POSTURE) * T_flange_camera * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    T_world_board = aim * pin.SE3(np.eye(3), -MIDDLE)
    rng = np.random.default_rng(3)
    rows = []
    while len(rows) < 10:
        q = POSTURE + rng.uniform(-0.5, 0.5, robot.n)
        T = (robot.forward_kinematics(q) * T_flange_camera).actInv(T_world_board)
        pixels = camera.project(BOARD.corners @ T.rotation.T + T.translation)[0]
        # Whole, and tilted: the lens needs both.
        if not ((pixels > 15) & (pixels < [625, 465])).all() or T.rotation[2, 2] > np.cos(0.3):
            continue
        name = f"{len(rows)}.png"
        (folder / name).write_bytes(png(drawn(camera, T)))
        rows.append([name, *(repr(float(angle)) for angle in q)])
    with (folder / "frames.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["picture", *(f"{name}_rad" for name in robot.joint_names)])
        writer.writerows(rows)
    return folder


@pytest.fixture
def folder(originals, tmp_path, monkeypatch, camera):
    """A copy of it to be spoiled, in the folder in which commands run; the camera's file lies beside it."""
    monkeypatch.chdir(tmp_path)
    copy = tmp_path / "views"
    copy.mkdir()
    for path in originals.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    (tmp_path / "pinhole.toml").write_text(camera_toml(camera), encoding="utf-8")
    return copy


LENS = ("camera", "views", "--camera", "pinhole.toml", "--out", "lens.toml")
MOUNT = ("handeye", "views", "--camera", "pinhole.toml", "--out", "mounted.toml")


@pytest.fixture
def refused(folder, capsys):
    """Run a command that must be refused; returns the message."""

    def run(*arguments):
        before = {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()}
        assert main(["calibrate", *arguments]) == BAD_INPUT
        captured = capsys.readouterr()
        assert captured.err.startswith("dyngrasp: error: ")
        assert captured.err.count("\n") == 1
        assert {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()} == before
        return captured.err

    return run


def test_drawn_pictures_give_lens_and_mount_back(folder, camera, capsys):
    assert main(["calibrate", *LENS]) == DELIVERED
    lens = load_camera("lens.toml")
    # Ten small pictures of the middle of the view: a percent; the bound on the error is that of every calibration.
    np.testing.assert_allclose(lens.focal, camera.focal, rtol=0.01)
    assert _error(capsys.readouterr().out) < 0.3
    assert main(["calibrate", *MOUNT]) == DELIVERED
    assert _error(capsys.readouterr().out) < 0.3
    difference = pin.log6(load_camera("mounted.toml").T_hand_camera.actInv(camera.T_hand_camera)).vector
    assert np.linalg.norm(difference[:3]) < 1e-3
    assert np.linalg.norm(difference[3:]) < np.deg2rad(0.1)


def _error(printed):
    return float(printed.split("reprojection error ")[1].split()[0])


def test_other_pictures_are_left_out_and_said_to_be(folder, capsys):
    size = read_picture(folder / "0.png").shape
    (folder / "wall.png").write_bytes(png(np.full(size, 128, np.uint8)))
    assert main(["calibrate", *LENS]) == DELIVERED
    printed = capsys.readouterr().out
    assert "no board seen" in printed
    assert "10 of 11 views used" in printed


def test_nothing_is_written_over(refused, folder):
    assert main(["calibrate", *LENS]) == DELIVERED
    for command in (LENS, (*MOUNT[:-1], "lens.toml"), ("board", "--out", "lens.toml")):
        assert "lens.toml" in refused(*command)
    assert "views" in refused("render", "views")


def test_a_folder_that_cannot_be_written_into(refused):
    assert "nowhere" in refused(*LENS[:-1], "nowhere/lens.toml")


def test_a_drawing_that_would_have_no_size(refused):
    assert ".svg" in refused("board", "--out", "board.png")


@pytest.mark.parametrize("command", [LENS, MOUNT])
class TestPicturesThatCannotBeUsed:
    def test_no_folder(self, refused, command):
        assert "elsewhere" in refused(command[0], "elsewhere", *command[2:])

    def test_too_few(self, refused, folder, command):
        for k in range(4, 10):
            (folder / f"{k}.png").unlink()
        lines = (folder / "frames.csv").read_text().splitlines(keepends=True)
        (folder / "frames.csv").write_text("".join(lines[:5]))
        message = refused(*command)
        assert "4" in message
        assert "at least 5" in message

    def test_no_board(self, refused, folder, command):
        for path in folder.glob("*.png"):
            path.write_bytes(png(np.full_like(read_picture(path), 128)))
        assert "at least 5" in refused(*command)

    def test_another_board(self, refused, command):
        for option, value, words in (("--dictionary", "6x6_50", "6x6_50"), ("--columns", "9", "9 x 6")):
            message = refused(*command, option, value)
            assert "at least 5" in message
            assert words in message

    def test_another_size(self, refused, folder, command):
        (folder / "3.png").write_bytes(png(np.zeros((240, 320), np.uint8)))
        message = refused(*command)
        for words in ("3.png", "320 x 240", "640 x 480"):
            assert words in message

    def test_a_broken_picture(self, refused, folder, command):
        (folder / "3.png").write_bytes((folder / "3.png").read_bytes()[:200])
        assert "3.png" in refused(*command)

    @pytest.mark.parametrize(
        ("name", "words"),
        [("ava2000", ("ava2000", "ava1000")), ("nowhere.toml", ("nowhere.toml",)), ("views/0.png", ("0.png",))],
    )
    def test_a_camera_that_is_none(self, refused, command, name, words):
        message = refused(*command[:3], name, *command[4:])
        for word in words:
            assert word in message

    @pytest.mark.parametrize(
        ("option", "value", "words"),
        [("--columns", "2", ("3",)), ("--marker-mm", "31", ("marker",)), ("--rows", "40", ("markers",))],
    )
    def test_a_board_that_cannot_be(self, refused, command, option, value, words):
        message = refused(*command, option, value)
        for word in words:
            assert word in message


class TestTablesThatCannotBeUsed:
    def test_none(self, refused, folder):
        (folder / "frames.csv").unlink()
        assert "frames.csv" in refused(*MOUNT)

    def test_a_joint_is_missing(self, refused, folder):
        _replace(folder, "A3_rad", "elbow")
        message = refused(*MOUNT)
        for words in ("frames.csv", "A3_rad", "A3_deg"):
            assert words in message

    def test_degrees_where_radians_are_meant(self, refused, folder):
        path = folder / "frames.csv"
        with path.open(newline="") as file:
            names, *rows = csv.reader(file)
        rows = [[row[0], *(repr(float(np.rad2deg(float(value)))) for value in row[1:])] for row in rows]
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([names, *rows])
        message = refused(*MOUNT)
        for words in ("frames.csv", "row 1", "iiwa14", "_deg"):
            assert words in message

    def test_no_number(self, refused, folder):
        lines = (folder / "frames.csv").read_text().splitlines(keepends=True)
        lines[2] = lines[2].rsplit(",", 1)[0] + ",soon\n"
        (folder / "frames.csv").write_text("".join(lines))
        message = refused(*MOUNT)
        for words in ("row 2", "A7_rad", "soon"):
            assert words in message

    def test_a_picture_that_is_not_there(self, refused, folder):
        (folder / "7.png").unlink()
        assert "7.png" in refused(*MOUNT)

    def test_a_hand_that_never_turned(self, refused, folder):
        lines = (folder / "frames.csv").read_text().splitlines(keepends=True)
        angles = lines[1].split(",", 1)[1]
        (folder / "frames.csv").write_text(lines[0] + "".join(f"{k}.png,{angles}" for k in range(10)))
        assert "second axis" in refused(*MOUNT)


def test_views_without_tilt_give_no_lens(refused, folder, camera):
    for k in range(10):
        T = pin.SE3(np.eye(3), np.array([0.01 * (k % 3), 0.01 * (k % 2), 0.4 + 0.01 * k]) - MIDDLE)
        (folder / f"{k}.png").write_bytes(png(drawn(camera, T)))
    message = refused(*LENS)
    assert "focal length" in message
    assert "tilt" in message


@pytest.mark.parametrize(
    "arguments",
    [("board", "--square-mm", "0"), ("board", "--columns", "x"), ("camera", "views"), ("lens",), ()],
)
def test_usage(arguments, folder, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", *arguments])
    assert stopped.value.code == BAD_INPUT
    assert "usage: dyngrasp calibrate" in capsys.readouterr().err


def _replace(folder, old, new):
    path = folder / "frames.csv"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_families_of_markers_are_those_of_the_models():
    assert tuple(MARKER_DICTIONARIES) == DICTIONARIES
