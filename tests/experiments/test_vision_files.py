"""Pictures that a camera took, as files: written, read and worked out again; and everything a run with one leaves."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.cli import main
from dyngrasp.closed_loop.camera_poses import CameraPoses, CameraPosesSettings
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import InputFileError, RenderingUnavailable
from dyngrasp.experiments.output import OutputFolder
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.vision import recorded_poses
from dyngrasp.experiments.vision_files import COLUMNS, perceive, write_pictures
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.part_tracker import PartTracker
from dyngrasp.perception.picture_files import png, read_picture
from dyngrasp.perception.picture_folder import TABLE, read_table
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.camera_sensor import CameraSensor
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene

SCENARIO = Path(__file__).parents[2] / "scenarios" / "camera_sdh2.toml"
ABOVE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])
SPEED = np.deg2rad([10.0, 6.0, 0.0, 0.0, 0.0, -8.0, 10.0])


@pytest.fixture(scope="module")
def workcell():
    return load_workcell(load_scenario(SCENARIO), SCENARIO)


@pytest.fixture(scope="module")
def filmed(workcell):
    """The part under a moving hand, every second picture kept: the record, and where the part was."""
    task = workcell.task
    camera = workcell.camera
    spot = task.robot.forward_kinematics(ABOVE) * task.gripper.T_flange_hand * camera.T_hand_camera
    T_part = pin.SE3(pin.utils.rotate("z", 2.6), np.array([*spot.translation[:2], 0.1]))
    scene = build_scene(task.robot, task.gripper, task.grasp_object, markers=True)
    state = MujocoPlant(scene, ABOVE, task.gripper.open_posture, T_part).state
    prior = PoseEstimate(T_part * pin.SE3(np.eye(3), np.full(3, 0.01)), np.diag(np.repeat(1e-3, 6)), 0.0, 0.0)
    tracker = PartTracker(MarkerPoseSolver(camera, task.grasp_object), task.robot, task.gripper, prior)
    try:
        with CameraSensor(scene, camera) as sensor:
            poses = CameraPoses(sensor, MarkerDetector(task.grasp_object), tracker, CameraPosesSettings(keep_every=2))
            for t in np.arange(0.0, 0.5, 1e-3):
                here = state.copy()
                here[scene.arm_qpos] = ABOVE + SPEED * t
                poses.watch(t, here, ABOVE + SPEED * t)
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    return poses.finish(), T_part


@pytest.fixture
def folder(filmed, tmp_path):
    out = OutputFolder(tmp_path / "pictures")
    write_pictures(filmed[0], out)
    return out.path


def test_what_is_worked_out_from_the_files_is_what_the_camera_gave(filmed, folder, workcell):
    vision, T_part = filmed
    seen = perceive(workcell, folder)
    assert len(seen) == len(vision.pictures) == 8
    for (taken, report), number in zip(seen, sorted(vision.pictures), strict=True):
        expected = vision.reports[number].frame
        np.testing.assert_array_equal(read_picture(taken.path), vision.pictures[number])
        assert (report.frame.t_capture, report.frame.t_receipt) == (expected.t_capture, expected.t_receipt)
        np.testing.assert_array_equal(report.frame.arm_position, expected.arm_position)
        assert report.frame.seen == expected.seen != ()
        for one, other in zip(report.frame.markers, expected.markers, strict=True):
            np.testing.assert_array_equal(one.corners, other.corners)
    estimate = seen[-1][1].estimate
    assert estimate is not None
    error = pin.log6(estimate.T_world_object.actInv(T_part)).vector
    assert np.linalg.norm(error[:3]) < 1.5e-3
    assert np.linalg.norm(error[3:]) < np.deg2rad(0.5)


def test_pictures_of_an_earlier_run_go(filmed, folder):
    vision, _ = filmed
    picture = png(vision.pictures[0])
    (folder / "0001.png").write_bytes(picture)
    (folder / "mine.png").write_bytes(picture)
    write_pictures(vision, OutputFolder(folder))
    expected = {f"{number:04d}.png" for number in vision.pictures} | {"mine.png", TABLE}
    assert {path.name for path in folder.iterdir()} == expected


def test_the_command_writes_a_row_for_each_picture(filmed, folder, tmp_path, capsys):
    _, T_part = filmed
    out = tmp_path / "poses.csv"
    assert main(["perceive", str(SCENARIO), str(folder), "--out", str(out)]) == 0
    assert "casting at" in capsys.readouterr().out
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == 8
    # Four pictures that agree begin.
    assert [row["x_m"] == "" for row in rows] == [True] * 3 + [False] * 5
    last = rows[-1]
    found = np.array([float(last[name]) for name in ("x_m", "y_m", "z_m")])
    np.testing.assert_allclose(found, T_part.translation, atol=1.5e-3)
    quat = pin.Quaternion(*(float(last[f"quat_{name}"]) for name in "wxyz"))
    assert quat.angularDistance(pin.Quaternion(T_part.rotation)) < np.deg2rad(0.5)
    assert 0 < float(last["deviation_mm"]) < 5


def test_pictures_without_the_part_exit_with_one(folder, tmp_path, capsys):
    for path in folder.glob("*.png"):
        path.write_bytes(png(np.full_like(read_picture(path), 128)))
    assert main(["perceive", str(SCENARIO), str(folder), "--out", str(tmp_path / "poses.csv")]) == 1
    assert "not found" in capsys.readouterr().out


def test_angles_may_be_in_degrees_and_times_of_receipt_missing(folder, workcell):
    joints = workcell.task.robot.joint_names
    before = read_table(folder, joints)
    with (folder / TABLE).open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = ["note", *(f"{joint}_deg" for joint in joints), "picture", "t_capture_s"]
    lines = [",".join(names)]
    for row in reversed(rows):
        degrees = [repr(float(np.rad2deg(float(row[f"{joint}_rad"])))) for joint in joints]
        lines.append(",".join(["hello", *degrees, row["picture"], row["t_capture_s"]]))
    (folder / TABLE).write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    after = read_table(folder, joints)
    assert [picture.path for picture in after] == [picture.path for picture in before]
    for one, other in zip(after, before, strict=True):
        np.testing.assert_allclose(one.arm_position, other.arm_position, atol=1e-14)
        assert one.t_receipt == one.t_capture == other.t_capture


class TestFoldersThatCannotBeUsed:
    def refused(self, workcell, folder, *words):
        with pytest.raises(InputFileError) as error:
            perceive(workcell, folder)
        for word in words:
            assert word in str(error.value)

    def edit(self, folder, old, new):
        table = folder / TABLE
        text = table.read_text()
        assert old in text
        table.write_text(text.replace(old, new))

    def test_no_table(self, workcell, folder):
        (folder / TABLE).unlink()
        self.refused(workcell, folder, TABLE, "cannot be read")

    def test_an_empty_table(self, workcell, folder):
        (folder / TABLE).write_text("picture,t_capture_s\n")
        self.refused(workcell, folder, TABLE, "at least one row")

    def test_a_table_that_is_none(self, workcell, folder):
        shutil.copy(folder / "0000.png", folder / TABLE)
        self.refused(workcell, folder, TABLE)

    @pytest.mark.parametrize("column", ["picture", "t_capture_s", "A3_rad"])
    def test_a_missing_column(self, workcell, folder, column):
        self.edit(folder, column, "other")
        self.refused(workcell, folder, TABLE, column)

    @pytest.mark.parametrize("value", ["soon", "nan", ""])
    def test_a_time_that_is_none(self, workcell, folder, value):
        self.edit(folder, "0000.png,0.001,", f"0000.png,{value},")
        self.refused(workcell, folder, TABLE, "row 1: t_capture_s")

    def test_a_receipt_before_the_capture(self, workcell, folder):
        self.edit(folder, "0000.png,0.001,", "0000.png,0.5,")
        self.refused(workcell, folder, TABLE, "row 1: t_receipt_s")

    def test_a_missing_picture(self, workcell, folder):
        (folder / "0002.png").unlink()
        self.refused(workcell, folder, "0002.png")

    def test_a_picture_that_is_none(self, workcell, folder):
        (folder / "0002.png").write_text("no picture")
        self.refused(workcell, folder, "0002.png", "PNG or JPEG")

    def test_a_picture_of_another_size(self, workcell, folder):
        (folder / "0002.png").write_bytes(png(np.zeros((240, 320), np.uint8)))
        self.refused(workcell, folder, "0002.png", "320 x 240", "640 x 480", "camera.width")


@pytest.mark.slow
def test_a_run_leaves_what_its_estimates_can_be_repeated_from(workcell, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--set", "camera.keep_every=10", "--no-video", "--out", str(out)]
    assert main(["run", str(SCENARIO), *options]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    summary = json.loads((out / "summary.json").read_text())
    vision = VisionRecord.load(out / "vision.npz")
    assert len(vision.reports) == summary["vision"]["frames"] > 60
    kept = len(list((out / "pictures").glob("*.png")))
    assert kept == summary["vision"]["pictures_kept"] == -(-len(vision.reports) // 10)
    assert f"detections and estimates of {len(vision.reports)} pictures in" in printed
    assert f"{kept} of the pictures in" in printed
    assert vision.meta["scenario"]["pose"]["source"] == "camera"

    source = recorded_poses(workcell, vision)
    source.estimate(None, vision.reports[-1].frame.t_receipt)
    # Nothing is believed before four pictures agree.
    assert [report.estimate is None for report in vision.reports[:5]] == [True] * 3 + [False] * 2
    for one, stored in zip(source.tracker.reports, vision.reports, strict=True):
        assert one.verdict == stored.verdict
        if stored.estimate is None:
            assert one.estimate is None
            continue
        assert one.estimate is not None
        np.testing.assert_array_equal(one.estimate.covariance, stored.estimate.covariance)
        T, T_stored = one.estimate.T_world_object, stored.estimate.T_world_object
        np.testing.assert_array_equal(T.homogeneous, T_stored.homogeneous)
    assert summary["first_look"]["frames"] == 4
