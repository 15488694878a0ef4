"""Pictures of the running simulation: markers are where the camera model says, and poses come out of them."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem, RenderingUnavailable
from dyngrasp.models.catalogue import load_camera
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver, corners_in_object
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, Verdict
from dyngrasp.signals import Command
from dyngrasp.simulation import gl_backend
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene

# The hand half a metre above the ground, looking straight down.
ABOVE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])


@pytest.fixture(scope="module")
def marked(robot, gripper, casting):
    return build_scene(robot, gripper, casting, markers=True)


@pytest.fixture(scope="module")
def camera():
    return load_camera("ava1000").scaled(640, 480)


@pytest.fixture(scope="module")
def sensor(marked, camera):
    try:
        gl_backend.require()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    with CameraSensor(marked, camera) as sensor:
        yield sensor


@pytest.fixture(scope="module")
def state(marked, gripper, casting):
    """Generalised positions with the hand above an empty place."""
    place = pin.SE3(np.eye(3), np.array([0.9, 0.9, casting.rest_height]))
    return MujocoPlant(marked, ABOVE, gripper.open_posture, place).state


@pytest.fixture(scope="module")
def put(marked):
    """`put(state, T_world_part)`: the state with the part elsewhere."""

    def put(state, T):
        x, y, z, w = pin.Quaternion(T.rotation).coeffs()
        moved = state.copy()
        moved[marked.part_qpos : marked.part_qpos + 7] = [*T.translation, w, x, y, z]
        return moved

    return put


def before_camera(distance, tilt=0.0, yaw=0.0, turn=0.0, aside=(0.0, 0.0)):
    """T_camera_object with the upper markers at a distance (m), the part turned and tilted (rad)."""
    R = pin.exp3(tilt * np.array([np.cos(turn), np.sin(turn), 0.0])) @ np.diag([1.0, -1.0, -1.0])
    T = pin.SE3(R @ pin.exp3(np.array([0.0, 0.0, yaw])), np.array([*aside, distance]))
    return T * pin.SE3(np.eye(3), np.array([-0.02, 0.0, 0.055]))


def error(found, true):
    return pin.log6(found.actInv(true)).vector


def test_markers_are_where_the_camera_model_says(sensor, camera, casting, state, put):
    random = np.random.default_rng(1)
    detector, solver = MarkerDetector(casting), MarkerPoseSolver(camera, casting)
    markers = {marker.id: marker for marker in casting.markers}
    T_world_camera = sensor.pose(state)
    offsets, errors, seen = [], [], set()
    for _ in range(30):
        T = before_camera(
            random.uniform(0.25, 0.6), random.uniform(0, 0.5), random.uniform(-3.1, 3.1), random.uniform(-3.1, 3.1)
        )
        image = sensor.capture([put(state, T_world_camera * T)], [0.0])
        found = detector.detect(image.pixels)
        for marker in found:
            seen.add(marker.id)
            ideal, _ = camera.project(corners_in_object(markers[marker.id]) @ T.rotation.T + T.translation)
            if marker.id <= 2:  # seen from above; the others at a grazing angle
                offsets.append(marker.corners - ideal)
        best = solver.solve(found).candidates[0]
        e = error(best.T_camera_object, T)
        errors.append([np.linalg.norm(e[:3]), np.linalg.norm(e[3:])])
    assert {0, 1, 2} <= seen
    assert len(offsets) > 60
    # A lens or a frustum that is off by half a pixel, or a marker by 0.3 mm, would shift all of them.
    assert np.abs(np.mean(offsets, axis=(0, 1))).max() < 0.1
    assert np.median(np.abs(offsets)) < 0.2
    # A single frame of 640 × 480; the filter is asked for 1.5 mm and 0.5°.
    position, angle = np.median(errors, axis=0)
    assert position < 1e-3
    assert angle < np.deg2rad(0.5)


def test_the_filter_finds_a_part_at_rest_from_a_moving_hand(sensor, camera, casting, state, put, marked):
    detector, solver = MarkerDetector(casting), MarkerPoseSolver(camera, casting)
    pose_filter = PoseFilter(PoseFilterSettings.still())
    T_true = sensor.pose(state) * before_camera(0.5, tilt=0.1, yaw=0.4)
    verdicts = []
    for k in range(15):
        here = put(state, T_true)
        # The arm turns its base and its wrist: the hand sweeps over the part by 4 cm and tilts by 5°.
        here[marked.arm_qpos] += np.deg2rad([0.4, 0.3, 0.0, 0.0, 0.0, -0.5, 0.3]) * k
        t = k / camera.rate
        image = sensor.capture([here], [t])
        sighting = solver.solve(detector.detect(image.pixels))
        T_world_camera = sensor.pose(here)
        frame = [c.in_world(T_world_camera, image.t_capture, t + 0.01) for c in sighting.candidates]
        if frame:
            verdicts.append(pose_filter.update(frame, now=t + 0.01))
    assert verdicts[:4] == [Verdict.GATED] * 3 + [Verdict.ACQUIRED]
    assert verdicts.count(Verdict.ACCEPTED) >= 10
    estimate = pose_filter.estimate(t)
    e = error(estimate.T_world_object, T_true)
    assert np.linalg.norm(e[:3]) < 1.5e-3
    assert np.linalg.norm(e[3:]) < np.deg2rad(0.5)
    assert np.abs(e / np.sqrt(np.diag(estimate.covariance))).max() < 5


def test_fingers_hide_what_is_behind_them(sensor, casting, state, put, marked, gripper):
    detector = MarkerDetector(casting)
    open_hand = put(state, sensor.pose(state) * before_camera(0.4, aside=(-0.08, 0.0)))
    closed_hand = open_hand.copy()
    closed_hand[marked.gripper_qpos] = gripper.closed_posture
    seen = [{m.id for m in detector.detect(sensor.capture([s], [0.0]).pixels)} for s in (open_hand, closed_hand)]
    assert seen == [{0, 1, 2}, {1, 2}]


def test_motion_is_smeared_about_the_middle_of_the_exposure(marked, camera, casting, state, put):
    detector = MarkerDetector(casting)
    quiet = ImagingSettings(noise=0.0, shot_noise=0.0)
    with CameraSensor(marked, camera, quiet) as sensor:
        T_world_camera = sensor.pose(state)
        # 0.5 m/s over 4 ms: 2 mm, or 4 pixels.
        times = 0.1 + np.linspace(0.0, 4e-3, 9)
        poses = [
            T_world_camera * pin.SE3(np.eye(3), np.array([0.5 * (t - 0.102), 0.0, 0.0])) * before_camera(0.45, 0.2)
            for t in times
        ]
        smeared = sensor.capture([put(state, T) for T in poses], times.tolist())
        sharp = sensor.capture([put(state, poses[4])], [times[4]])
    assert smeared.t_open == pytest.approx(0.1)
    assert smeared.t_close == pytest.approx(0.104)
    assert smeared.t_capture == pytest.approx(0.102)
    # Blur takes the steepest edges along the motion away.
    steep = [np.abs(np.diff(image.pixels.astype(float), axis=1)).max() for image in (sharp, smeared)]
    assert steep[1] < 0.6 * steep[0]
    markers = {marker.id: marker for marker in casting.markers}
    found = [marker for marker in detector.detect(smeared.pixels) if marker.id <= 2]
    assert len(found) >= 2

    def offset(T):
        corners = [corners_in_object(markers[m.id]) @ T.rotation.T + T.translation for m in found]
        ideal, _ = camera.project(np.vstack(corners))
        return abs(np.mean(np.vstack([m.corners for m in found]) - ideal, axis=0)[0])

    # The exposure begins and ends 2 pixels from its middle: 1 mm at f = 909 px and 0.45 m.
    begun, middle, ended = (offset(T_world_camera.actInv(poses[k])) for k in (0, 4, 8))
    assert middle < 0.2
    assert begun == pytest.approx(2.0, abs=0.3)
    assert ended == pytest.approx(2.0, abs=0.3)


def test_light_and_noise(marked, camera, state):
    def picture(**settings):
        with CameraSensor(marked, camera, ImagingSettings(samples=0, **settings)) as sensor:
            return [sensor.capture([state], [0.0]).pixels.astype(float) for _ in range(2)]

    ideal, again = picture(noise=0.0, shot_noise=0.0, vignetting=0.0)
    np.testing.assert_array_equal(ideal, again)
    noisy, other = picture(noise=3.0, shot_noise=0.0, vignetting=0.0)
    middle = (ideal > 20) & (ideal < 235)
    # Of 300 000 pixels; rounding adds 1/12.
    assert (noisy - ideal)[middle].std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)
    assert np.corrcoef((noisy - ideal)[middle], (other - ideal)[middle])[0, 1] < 0.02
    seeded = picture(noise=3.0, shot_noise=0.0, vignetting=0.0)[0]
    np.testing.assert_array_equal(seeded, noisy)
    darker = picture(noise=0.0, shot_noise=0.0, vignetting=0.4, brightness=0.5)[0]
    np.testing.assert_allclose(darker[235:245, 315:325], 0.5 * ideal[235:245, 315:325], atol=1.0)
    np.testing.assert_allclose(darker[:3, -3:], 0.5 * 0.6 * ideal[:3, -3:], atol=2.0)


def test_stickers_change_no_physics(scene, marked, make_plant, gripper):
    bare, stuck = make_plant(scene, position=(0.6, 0.1, 0.12)), make_plant(marked, position=(0.6, 0.1, 0.12))
    assert marked.model.body_mass.sum() == scene.model.body_mass.sum()
    nothing = Command(np.zeros(7), np.zeros(gripper.m))
    for _ in range(100):
        bare.step(nothing)
        stuck.step(nothing)
    # The part fell on the ground meanwhile.
    np.testing.assert_array_equal(bare.state, stuck.state)


def test_bad_exposures_are_refused(sensor, state):
    for states, times in (([], []), ([state], [0.0, 1.0]), ([state, state], [1.0, 1.0])):
        with pytest.raises(InvalidProblem, match="ascending"):
            sensor.capture(states, times)


@pytest.mark.parametrize(
    "settings", [{"brightness": 0.0}, {"noise": -1.0}, {"shot_noise": np.nan}, {"vignetting": 1.0}, {"samples": 3}]
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(InvalidProblem):
        ImagingSettings(**settings)


def test_a_machine_that_cannot_draw_says_so(marked, camera, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(RenderingUnavailable, match=r"libegl1|MUJOCO_GL"):
        CameraSensor(marked, camera)
