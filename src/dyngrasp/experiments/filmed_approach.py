"""A hand that approaches a part with its camera on it, picture by picture: what detection makes of it, and the truth.

Pictures cost most of the time and detection most of the rest; what follows works on the corners. So these are kept:
poses, filters and noise models can be worked out from the same films again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.catalogue import load_camera, load_gripper, load_object, load_robot
from dyngrasp.models.grasp_object import GraspObject
from dyngrasp.models.inverse_kinematics import inverse_kinematics_for
from dyngrasp.perception.marker_detection import MarkerCorners, MarkerDetector
from dyngrasp.signals import Array
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings, Picture
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import Scene, build_scene

Motion = Literal["still", "conveyor", "turning"]

# Of the part: a belt along x of the world (m/s), a slow turntable (rad/s).
BELT_SPEED, TURN_RATE = 0.1, 0.2

# How the approach begins and ends: distance of the camera from the part's middle (m), and largest tilt against the
# vertical (rad). At 0.25 m the upper markers just fill a picture of 640 × 480.
BEGINNING, END = ((0.45, 0.60), 0.45), ((0.25, 0.35), 0.25)

# The part's middle, as the camera sees it: within this of the optical axis (m).
ASIDE = 0.02

# Of the object frame: between the upper markers.
MIDDLE = np.array([0.02, 0.0, -0.055])

FRAMES = 40

# Near it the hand looks straight down, 0.6 m above the ground.
POSTURE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])

# Of draws of part and camera that no posture of the arm belongs to.
ATTEMPTS = 200


@dataclass(frozen=True, eq=False)
class Film:
    """One approach.

    Attributes:
        times: (k,) middles of the exposures (s).
        T_world_camera: k true poses of the camera.
        T_world_object: k true poses of the part.
        corners: What was detected in each picture.
    """

    times: Array
    T_world_camera: tuple[pin.SE3, ...]
    T_world_object: tuple[pin.SE3, ...]
    corners: tuple[tuple[MarkerCorners, ...], ...]

    @property
    def T_camera_object(self) -> tuple[pin.SE3, ...]:
        """True views."""
        return tuple(c.actInv(o) for c, o in zip(self.T_world_camera, self.T_world_object, strict=True))


class FilmSet:
    """Arm, hand, part and camera with which films are made; from `film_set`."""

    def __init__(self, sensor: CameraSensor, scene: Scene, part: GraspObject, resting: Array) -> None:
        """Used by `film_set`; `resting` are all generalised positions, of which arm and part are replaced."""
        self.camera, self.part = sensor.camera, part
        self.detector = MarkerDetector(part)
        self._sensor, self._scene, self._resting = sensor, scene, resting
        self._robot, self._gripper = load_robot("iiwa14"), load_gripper("sdh2")
        self._kinematics = inverse_kinematics_for(self._robot)

    def shoot(
        self, rng: np.random.Generator, motion: Motion = "still", frames: int = FRAMES,
        watch: Callable[[Picture], None] = lambda pixels: None,
    ) -> Film:  # fmt: skip
        """Draw an approach and look at it.

        The hand moves from rest to rest between two postures, the part uniformly; the camera ends above where the part
        then is.

        Args:
            rng: Draws it.
            motion: Of the part.
            frames: How many, at the camera's rate.
            watch: Given each picture.
        """
        times = np.arange(frames) / self.camera.rate
        for _ in range(ATTEMPTS):
            poses = _part_poses(rng, motion, times, self.part.rest_height)
            try:
                first = self._posture(poses[0] * _view(rng, *BEGINNING).inverse(), POSTURE)
                last = self._posture(poses[-1] * _view(rng, *END).inverse(), first)
            except OutOfReach:
                continue
            # The same branch of the arm, and no half turn of a joint on the way.
            if np.abs(last - first).max() < 1.0:
                break
        else:
            raise InvalidProblem(f"{ATTEMPTS} draws without an approach that the arm can follow")
        phase = times / times[-1] if frames > 1 else times
        smooth = phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2)
        cameras, corners = [], []
        for t, share, T in zip(times, smooth, poses, strict=True):
            state = self._state(first + share * (last - first), T)
            image = self._sensor.capture([state], [t])
            watch(image.pixels)
            cameras.append(self._sensor.pose(state))
            corners.append(self.detector.detect(image.pixels))
        return Film(times, tuple(cameras), tuple(poses), tuple(corners))

    def look(self, T_camera_object: pin.SE3) -> Picture:
        """One picture of the part in a view that needs no posture: the hand stays where it is."""
        state = self._resting
        return self._sensor.capture([self._state(POSTURE, self._sensor.pose(state) * T_camera_object)], [0.0]).pixels

    def _posture(self, T_world_camera: pin.SE3, near: Array) -> Array:
        T_hand_camera = self._gripper.T_flange_hand * self.camera.T_hand_camera
        return self._kinematics.nearest(T_world_camera * T_hand_camera.inverse(), near)

    def _state(self, arm: Array, T_world_part: pin.SE3) -> Array:
        scene, state = self._scene, self._resting.copy()
        x, y, z, w = pin.Quaternion(T_world_part.rotation).coeffs()
        state[scene.arm_qpos] = arm
        state[scene.part_qpos : scene.part_qpos + 7] = [*T_world_part.translation, w, x, y, z]
        return state


@contextmanager
def film_set(camera: CameraModel | None = None, part: GraspObject | None = None, seed: int = 0) -> Iterator[FilmSet]:
    """Everything that films need.

    Args:
        camera: With which; the packaged one with pictures of 640 × 480 if left out.
        part: Which; the casting if left out.
        seed: Of the pictures' noise.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
    """
    camera = camera or load_camera("ava1000").scaled(640, 480)
    part = part or load_object("casting")
    robot, gripper = load_robot("iiwa14"), load_gripper("sdh2")
    scene = build_scene(robot, gripper, part, markers=True)
    resting = MujocoPlant(scene, POSTURE, gripper.open_posture, pin.SE3.Identity()).state
    with CameraSensor(scene, camera, ImagingSettings(seed=seed)) as sensor:
        yield FilmSet(sensor, scene, part, resting)


def view(distance: float, tilt: float, towards: float, turn: float, aside: Array) -> pin.SE3:
    """T_camera_object.

    Args:
        distance: From the camera to the part's middle (m).
        tilt: Of the view against the part's vertical (rad), about the direction `towards` (rad).
        towards: See `tilt`.
        turn: About the part's vertical (rad).
        aside: (2,) of the part's middle from the optical axis (m).
    """
    tilted = pin.exp3(tilt * np.array([np.cos(towards), np.sin(towards), 0.0]))
    facing = tilted @ np.diag([1.0, -1.0, -1.0]) @ pin.exp3(np.array([0.0, 0.0, turn]))
    return pin.SE3(facing, np.array([*aside, distance])) * pin.SE3(np.eye(3), -MIDDLE)


def _view(rng: np.random.Generator, distances: tuple[float, float], tilt: float) -> pin.SE3:
    towards, turn = rng.uniform(-np.pi, np.pi, 2)
    return view(rng.uniform(*distances), rng.uniform(0, tilt), towards, turn, rng.uniform(-ASIDE, ASIDE, 2))


def _part_poses(rng: np.random.Generator, motion: Motion, times: Array, height: float) -> list[pin.SE3]:
    start = np.array([rng.uniform(0.45, 0.65), rng.uniform(-0.25, 0.25), height])
    yaw = rng.uniform(-np.pi, np.pi)
    side = rng.choice([-1.0, 1.0])
    belt = np.array([side * BELT_SPEED if motion == "conveyor" else 0.0, 0.0, 0.0])
    rate = side * TURN_RATE if motion == "turning" else 0.0
    return [pin.SE3(pin.exp3(np.array([0.0, 0.0, yaw + rate * t])), start + belt * t) for t in times]
