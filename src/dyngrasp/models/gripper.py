"""The hand: where the grasp point goes as the fingers close, how far they open, what they weigh and can do."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import brentq

from dyngrasp.errors import GraspRefused
from dyngrasp.models.batch_dynamics import Attachments, BatchModel
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.signals import Array, read_only

EDGE = 1e-6  # share of the widest gap by which one may lie outside what the closing motion passes: rounding


@dataclass(frozen=True, eq=False)
class GripperModel:
    """A hand that pinches with two opposing pads. m is the number of planned joints; the others are locked.

    Attributes:
        name: As in the model file.
        description: One line for people.
        joint_names: Names of the m planned joints, the order of every q_h.
        lower: (m,) smallest positions (rad).
        upper: (m,) largest positions (rad).
        velocity: (m,) largest speeds (rad/s).
        acceleration: (m,) largest accelerations (rad/s²).
        torque: (m,) largest torques (Nm).
        T_flange_hand: Pose of the hand frame in the robot's flange frame.
        approach_axis: (3,) unit vector in the hand frame, the direction in which the hand meets a part.
        closing_axis: (3,) unit vector in the hand frame along which the pads meet.
        open_posture: (m,) widest posture of the closing motion (rad).
        closed_posture: (m,) its other end (rad).
        pads: Frames at the centres of the two tactile arcs, the one on the side of `closing_axis` first.
        pad_geoms: Names of the collision geoms that may touch a part.
        pad_radius: Radius of the tactile arcs (m).
        locked: Position (rad) of each joint that is held.
        pinch_force: Force (N) of one finger at its pad.
        pin_model: The whole hand with all its joints, its root fixed in the hand frame; not to be changed.
        mjcf_path: The MJCF description.
    """

    name: str
    description: str
    joint_names: tuple[str, ...]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    torque: Array
    T_flange_hand: pin.SE3
    approach_axis: Array
    closing_axis: Array
    open_posture: Array
    closed_posture: Array
    pads: tuple[str, str]
    pad_geoms: tuple[str, ...]
    pad_radius: float
    locked: dict[str, float]
    pinch_force: float
    pin_model: pin.Model
    mjcf_path: Path
    symbolic_cache: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "velocity", "acceleration", "torque", "open_posture", "closed_posture"):
            object.__setattr__(self, name, read_only(getattr(self, name), (self.m,)))
        for name in ("approach_axis", "closing_axis"):
            object.__setattr__(self, name, read_only(getattr(self, name), (3,)))

    @property
    def m(self) -> int:
        """Number of planned joints."""
        return len(self.joint_names)

    @cached_property
    def _data(self) -> pin.Data:
        return self.pin_model.createData()

    @cached_property
    def planned_indices(self) -> NDArray[np.intp]:
        """(m,) index of each planned joint in a configuration of `pin_model`."""
        return np.array([self.pin_model.joints[self.pin_model.getJointId(name)].idx_q for name in self.joint_names])

    @cached_property
    def pad_ids(self) -> tuple[int, int]:
        """Frame indices of the two arc centres in `pin_model`."""
        first, second = (frames_named(self.pin_model, pad)[0] for pad in self.pads)
        return first, second

    def full_configuration(self, q_h: Array) -> Array:
        """Configuration of `pin_model` at the planned posture q_h (m,), locked joints at their angles."""
        q = np.empty(self.pin_model.nq)
        for name, angle in self.locked.items():
            q[self.pin_model.joints[self.pin_model.getJointId(name)].idx_q] = angle
        q[self.planned_indices] = q_h
        return q

    def pad_centres(self, q_h: Array) -> Array:
        """(2, 3) arc centres of the two pads in the hand frame (m)."""
        pin.framesForwardKinematics(self.pin_model, self._data, self.full_configuration(q_h))
        return np.array([self._data.oMf[i].translation for i in self.pad_ids])

    def grasp_point(self, q_h: Array) -> Array:
        """p_G (3,) in the hand frame (m): the midpoint of the two arc centres."""
        return self.pad_centres(q_h).mean(axis=0)

    def grasp_point_many(self, q_h: Array) -> Array:
        """(K, 3) grasp points of the K postures q_h (K, m)."""
        q_h = np.atleast_2d(q_h)
        q = np.tile(self.full_configuration(self.open_posture)[:, None], (1, len(q_h)))
        q[self.planned_indices] = q_h.T
        return self._batch[0].poses(q, self._batch[1])[1].mean(axis=0).T

    @cached_property
    def _batch(self) -> tuple[BatchModel, Attachments]:
        """Kinematics for many postures at once, and the arc centres in it."""
        tree = BatchModel.from_pinocchio(self.pin_model)
        pads = (self.pin_model.frames[i] for i in self.pad_ids)
        return tree, tree.attach([(int(pad.parentJoint), pin.SE3(pad.placement)) for pad in pads])

    def grasp_point_jacobian(self, q_h: Array) -> Array:
        """(3, m) derivative of p_G with respect to q_h (m/rad)."""
        pin.computeJointJacobians(self.pin_model, self._data, self.full_configuration(q_h))
        pin.updateFramePlacements(self.pin_model, self._data)
        first, second = (
            pin.getFrameJacobian(self.pin_model, self._data, i, pin.LOCAL_WORLD_ALIGNED)[:3] for i in self.pad_ids
        )
        return (first + second)[:, self.planned_indices] / 2

    def aperture(self, q_h: Array) -> float:
        """Free gap between the pads along the closing axis (m), negative where they would overlap."""
        first, second = self.pad_centres(q_h)
        return float((first - second) @ self.closing_axis - 2 * self.pad_radius)

    @cached_property
    def max_aperture(self) -> float:
        """Free gap of the open posture (m)."""
        return self.aperture(self.open_posture)

    @cached_property
    def min_aperture(self) -> float:
        """Free gap of the closed posture (m)."""
        return self.aperture(self.closed_posture)

    def closing_posture(self, fraction: float) -> Array:
        """(m,) posture open + λ (closed − open) for λ = `fraction`."""
        return self.open_posture + fraction * (self.closed_posture - self.open_posture)

    def posture_for(self, gap: float) -> Array:
        """The posture on the closing motion whose free gap is `gap`.

        Args:
            gap: Wanted gap (m).

        Raises:
            GraspRefused: The gap is outside what the closing motion passes.
        """
        low, high = self.min_aperture, self.max_aperture
        if not low - EDGE * high <= gap <= high + EDGE * high:
            raise GraspRefused(
                f"{self.name} cannot make a gap of {gap * 1e3:.1f} mm: its closing motion goes from "
                f"{high * 1e3:.1f} mm to {low * 1e3:.1f} mm"
            )
        if gap >= high:
            return self.open_posture.copy()
        if gap <= low:
            return self.closed_posture.copy()
        fraction = brentq(lambda x: self.aperture(self.closing_posture(x)) - gap, 0.0, 1.0, xtol=1e-12)
        return self.closing_posture(fraction)  # type: ignore[arg-type]  # a float, unless the full output is asked for

    def inertia(self, q_h: Array) -> pin.Inertia:
        """Inertia of the whole hand at posture q_h (m,), in the hand frame."""
        pin.forwardKinematics(self.pin_model, self._data, self.full_configuration(q_h))
        total = self.pin_model.inertias[0].copy()
        for i in range(1, self.pin_model.njoints):
            total += self._data.oMi[i].act(self.pin_model.inertias[i])
        return total

    def payload(self, q_h: Array) -> pin.Inertia:
        """Inertia of the whole hand at posture q_h (m,), in the robot's flange frame, for `RobotModel.with_payload`."""
        return self.T_flange_hand.act(self.inertia(q_h))

    def T_hand_grasp(self, q_h: Array) -> pin.SE3:
        """Frame of the pinch in the hand frame: origin G, z against the approach axis, y along the closing axis.

        With it T_world_flange · T_flange_hand · T_hand_grasp = T_world_grasp when the pinch sits in the grasp frame.
        """
        y, z = self.closing_axis, -self.approach_axis
        return pin.SE3(np.column_stack([np.cross(y, z), y, z]), self.grasp_point(q_h))
