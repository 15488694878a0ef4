"""What flows along the arrows of the block diagram: small frozen values, SI units, one monotonic clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_Made = TypeVar("_Made")


_FLOAT = np.dtype(float)


def read_only(values: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    """`values` as a contiguous read-only float array: a copy, unless they are one that nobody can write to.

    Args:
        values: Anything numpy can turn into floats.
        shape: The shape it must have; −1 matches any length.

    Raises:
        ValueError: The shape differs.
    """
    array: Array = values if _is_frozen(values) else frozen(np.array(values, dtype=float, order="C"))  # type: ignore[assignment]
    if shape is not None:
        # A plain loop: this runs many times in every control period.
        fits = len(shape) == array.ndim
        for wanted, size in zip(shape, array.shape, strict=False):
            if wanted != size and wanted != -1:
                fits = False
        if not fits:
            raise ValueError(f"expected shape {shape}, got {array.shape}")
    return array


def vector(values: ArrayLike) -> Array:
    """`read_only` of one dimension, whatever its length; these are made in every control period.

    Raises:
        ValueError: Another number of dimensions.
    """
    array = read_only(values)
    if array.ndim != 1:
        raise ValueError(f"expected a vector, got shape {array.shape}")
    return array


def frozen(array: Array) -> Array:
    """The same array, read-only from now on: for one just made that nobody else holds, so that none has to copy it."""
    array.setflags(write=False)
    return array


def _is_frozen(values: ArrayLike) -> bool:
    """Whether these are contiguous floats in memory that belongs to a read-only array."""
    if type(values) is not np.ndarray or values.dtype is not _FLOAT:
        return False
    flags, owner = values.flags, values.base
    if flags.writeable or not flags.c_contiguous:
        return False
    if owner is None:
        return flags.owndata
    return type(owner) is np.ndarray and owner.flags.owndata and not owner.flags.writeable


def made(kind: type[_Made], **attributes: object) -> _Made:
    """A frozen dataclass of attributes that are known to be what it asks for: nothing is looked at a second time."""
    value = object.__new__(kind)
    value.__dict__.update(attributes)
    return value


@dataclass(frozen=True)
class JointState:
    """Position (rad), velocity (rad/s) and acceleration (rad/s²) of n joints, each of shape (n,), at time `t` (s)."""

    t: float
    position: Array
    velocity: Array
    acceleration: Array

    def __post_init__(self) -> None:
        for name in ("position", "velocity", "acceleration"):
            object.__setattr__(self, name, vector(getattr(self, name)))

    @classmethod
    def of(cls, t: float, state: Array) -> JointState:
        """A state of q, q̇, q̈ in one array (3, n), just made, that nobody else holds: it becomes read-only."""
        frozen(state)
        return made(cls, t=t, position=state[0], velocity=state[1], acceleration=state[2])


@dataclass(frozen=True)
class PoseEstimate:
    """Where the part is believed to be.

    Attributes:
        T_world_object: Estimated pose.
        covariance: (6, 6), of a right perturbation `T · exp(δ)` with δ = [translation (m), rotation (rad)].
        t_capture: When the light that this rests on was measured (s).
        t_receipt: When the estimate became available (s).
        twist_world: (6,), linear (m/s) and angular velocity (rad/s) of the part, world axes.
    """

    T_world_object: pin.SE3
    covariance: Array
    t_capture: float
    t_receipt: float
    twist_world: Array = field(default_factory=lambda: np.zeros(6))

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance, (6, 6)))
        object.__setattr__(self, "twist_world", read_only(self.twist_world, (6,)))


@dataclass(frozen=True)
class Observation:
    """What the sensors of the plant give: no velocities, they are filtered from positions.

    Attributes:
        t: Time of the measurement (s).
        arm_position: (n,) encoder positions (rad).
        gripper_position: (m,) positions of the planned gripper joints (rad).
        pad_force: (pads,) normal force on each tactile pad (N).
    """

    t: float
    arm_position: Array
    gripper_position: Array
    pad_force: Array

    def __post_init__(self) -> None:
        for name in ("arm_position", "gripper_position", "pad_force"):
            object.__setattr__(self, name, vector(getattr(self, name)))


@dataclass(frozen=True)
class Command:
    """Joint torques (Nm) for the arm, shape (n,), and for the planned gripper joints, shape (m,)."""

    arm_torque: Array
    gripper_torque: Array

    def __post_init__(self) -> None:
        for name in ("arm_torque", "gripper_torque"):
            object.__setattr__(self, name, vector(getattr(self, name)))
