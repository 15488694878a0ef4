"""The plant as controllers see it (`Plant`), and what only the record and the metrics may look at (`Truth`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, runtime_checkable

import pinocchio as pin

from dyngrasp.errors import DyngraspError
from dyngrasp.signals import Array, Command, Observation, read_only


class PlantDiverged(DyngraspError):
    """The simulation left the realm of numbers, or was given a command that is none; its state is not to be trusted."""


@runtime_checkable
class Plant(Protocol):
    """Joint torques in, sensor readings out. A simulator and a robot differ in nothing else."""

    @property
    def t(self) -> float:
        """Time of the plant (s)."""
        ...

    def observe(self) -> Observation:
        """What the sensors read now."""
        ...

    def step(self, command: Command) -> None:
        """Apply the torques for one control period."""
        ...


class ContactCategory(IntEnum):
    """Who touches whom; the index of the category in `Truth.contacts` and in the record."""

    PADS_PART = 0
    OTHER_ROBOT_PART = 1
    ROBOT_GROUND = 2
    PART_GROUND = 3
    ROBOT_ROBOT = 4


@dataclass(frozen=True)
class Truth:
    """What a simulator knows and no sensor tells.

    Attributes:
        t: Time (s).
        T_world_part: Pose of the part's object frame.
        part_twist: (6,), linear velocity of the object frame's origin (m/s) and angular velocity (rad/s), world axes.
        p_world_support: (3,) how far what the part stood on at first has moved (m); zero for the ground.
        T_world_hand: Pose of the hand frame.
        p_world_grasp_point: (3,), midpoint of the two pad frames (m): the grasp point G as the fingers stand.
        arm_position, arm_velocity: (n,) true joint states (rad, rad/s).
        gripper_position, gripper_velocity: (m,) true states of the planned gripper joints (rad, rad/s).
        pad_force: (pads,) normal force between each pad and the part (N).
        contacts: (5,) bool, whether contacts of each `ContactCategory` exist.
    """

    t: float
    T_world_part: pin.SE3
    part_twist: Array
    p_world_support: Array
    T_world_hand: pin.SE3
    p_world_grasp_point: Array
    arm_position: Array
    arm_velocity: Array
    gripper_position: Array
    gripper_velocity: Array
    pad_force: Array
    contacts: tuple[bool, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "part_twist", read_only(self.part_twist, (6,)))
        for name in ("p_world_support", "p_world_grasp_point"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3,)))
        for name in ("arm_position", "arm_velocity", "gripper_position", "gripper_velocity", "pad_force"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1,)))


class TruthfulPlant(Plant, Protocol):
    """A plant that can also be asked for the truth, as any simulator can: for the record, never for control."""

    def truth(self) -> Truth:
        """The state that the sensors only hint at."""
        ...

    @property
    def applied(self) -> Command:
        """The torques that the motors gave in the last step, after saturation."""
        ...

    @property
    def state(self) -> Array:
        """Generalised positions of everything in the scene, for the renderer."""
        ...
