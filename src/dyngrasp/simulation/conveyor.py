"""A plate under the part that slides at a set speed and carries it by friction, as a conveyor does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Array, read_only

if TYPE_CHECKING:
    from mujoco import MjModel, MjSpec

    from dyngrasp.simulation.scene import SceneSettings

CONVEYOR = "conveyor"

# Plate and what is on it; the servo must carry the part without a visible loss of speed.
_PLATE_MASS = 40.0  # kg
_SERVO_GAIN = 4e4  # N s/m

_DARK, _LIGHT = [0.16, 0.18, 0.20, 1.0], [0.93, 0.72, 0.18, 1.0]


@dataclass(frozen=True)
class Conveyor:
    """A straight conveyor in the ground's plane.

    Attributes:
        velocity: (2,) of its surface (m/s), world axes; if it runs for a while only, the mean over that time.
        centre: (2,) where the middle of the plate is at the start (m).
        length, width: Of the plate, along and across its motion (m).
        height: Of its surface above the ground (m): a part on it touches the plate alone.
        run: From when to when it runs (s): then from rest to rest, smoothly. Always, at one speed, if infinite.
    """

    velocity: Array
    centre: Array
    length: float = 1.6
    width: float = 0.24
    height: float = 0.001
    run: tuple[float, float] = (-np.inf, np.inf)

    def __post_init__(self) -> None:
        for name in ("velocity", "centre"):
            object.__setattr__(self, name, read_only(getattr(self, name), (2,)))
        if not (np.isfinite(self.velocity).all() and np.isfinite(self.centre).all()):
            raise InvalidProblem(f"conveyor: finite numbers expected, got {self.velocity}, {self.centre}")
        if min(self.length, self.width, self.height) <= 0:
            raise InvalidProblem("conveyor: length, width and height must be > 0")
        if not self.run[0] < self.run[1]:
            raise InvalidProblem(f"conveyor: it must stop after it starts, got {self.run} s")

    @property
    def speed(self) -> float:
        """Of its surface (m/s)."""
        return float(np.linalg.norm(self.velocity))

    def speed_at(self, t: float) -> float:
        """Of its surface at time t (m/s)."""
        start, stop = self.run
        if not start <= t <= stop:
            return 0.0
        if np.isinf(stop - start):
            return self.speed
        return self.speed * (1.0 - float(np.cos(2.0 * np.pi * (t - start) / (stop - start))))

    @property
    def direction(self) -> Array:
        """(3,) unit vector of its motion; x where it stands still."""
        if self.speed == 0.0:
            return np.array([1.0, 0.0, 0.0])
        return np.append(self.velocity / self.speed, 0.0)

    def twist_at(self, t: float) -> Array:
        """(6,) velocity of what stands on it at time t (m/s, rad/s)."""
        return np.concatenate([self.speed_at(t) * self.direction, np.zeros(3)])


def add_conveyor(spec: MjSpec, conveyor: Conveyor, settings: SceneSettings) -> None:
    """Add plate, slide joint and velocity servo; the servo is the last actuator of the world then."""
    heading = float(np.arctan2(conveyor.direction[1], conveyor.direction[0]))
    thickness = 0.02
    # It runs in a slot of the ground, which it does not touch.
    plate = spec.worldbody.add_body(
        name=CONVEYOR,
        pos=[*conveyor.centre, conveyor.height - thickness / 2],
        quat=[np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)],
    )
    plate.explicitinertial = True
    plate.mass = _PLATE_MASS
    plate.inertia = _PLATE_MASS / 12 * np.array([conveyor.width**2, conveyor.length**2, conveyor.length**2])
    plate.add_joint(name=CONVEYOR, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1.0, 0.0, 0.0])
    spec.add_material(name="conveyor", rgba=_DARK, specular=0.1, shininess=0.1)
    spec.add_material(name="conveyor_mark", rgba=_LIGHT, specular=0.1, shininess=0.1)
    plate.add_geom(
        name=CONVEYOR,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[conveyor.length / 2, conveyor.width / 2, thickness / 2],
        material="conveyor",
        friction=[settings.ground_friction, 0.005, 1e-4],
    )
    # Marks along both edges show that it moves; they touch nothing.
    for x in np.arange(-conveyor.length / 2 + 0.05, conveyor.length / 2, 0.1):
        for side in (-1.0, 1.0):
            plate.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[0.025, 0.004, 0.0002],
                pos=[x, side * (conveyor.width / 2 - 0.012), thickness / 2],
                material="conveyor_mark",
                contype=0,
                conaffinity=0,
                group=2,
            )
    spec.add_exclude(bodyname1="world", bodyname2=CONVEYOR)
    servo = spec.add_actuator(name=CONVEYOR, target=CONVEYOR, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_velocity(kv=_SERVO_GAIN)


@dataclass(frozen=True)
class ConveyorAddresses:
    """A conveyor, and where it is in MuJoCo's arrays."""

    conveyor: Conveyor
    qpos: int
    dof: int
    actuator: int


def locate_conveyor(model: MjModel, conveyor: Conveyor) -> ConveyorAddresses:
    """Addresses in a compiled world."""
    joint = model.joint(CONVEYOR)
    return ConveyorAddresses(conveyor, int(joint.qposadr[0]), int(joint.dofadr[0]), int(model.actuator(CONVEYOR).id))


def standing_on(conveyor: Conveyor, T_world_object: pin.SE3) -> pin.SE3:
    """The pose of a part that stood on the ground, put on the conveyor."""
    return pin.SE3(T_world_object.rotation, T_world_object.translation + np.array([0.0, 0.0, conveyor.height]))
