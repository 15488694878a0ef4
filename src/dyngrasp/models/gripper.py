"""The hand: where the grasp point goes as the fingers close, how far they open, what they weigh and can do."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import brentq

from dyngrasp.errors import GraspRefused, ModelFileError
from dyngrasp.models.batch_dynamics import Attachments, BatchModel
from dyngrasp.models.kinematic_tree import frame_id, frames_named, read_tree, require_in_range, require_length
from dyngrasp.models.model_file import Finite, Positive, StrictSchema, UnitQuaternion, Vector3, decode, read_toml
from dyngrasp.signals import Array, read_only

ROUNDING = 1e-6  # rad and unitless: numbers written with six decimals agree to this


class MountTable(StrictSchema):
    """`[mount]`: pose of the hand frame in the robot's flange frame."""

    position: Vector3
    quat_wxyz: UnitQuaternion


class PosturesTable(StrictSchema):
    """`[postures]`: the ends of the closing motion (rad), in the order of `joints`."""

    open: tuple[Finite, ...]
    closed: tuple[Finite, ...]


class GripperLimitsTable(StrictSchema):
    """`[limits]`: one entry a planned joint, in the order of `joints`."""

    position_lower_deg: tuple[Finite, ...]
    position_upper_deg: tuple[Finite, ...]
    velocity_deg_per_s: tuple[Positive, ...]
    acceleration_deg_per_s2: tuple[Positive, ...]
    torque_nm: tuple[Positive, ...]


class PinchTable(StrictSchema):
    """`[pinch]`: what one finger can press with at its pad (N)."""

    force_n: Positive


class GripperFile(StrictSchema):
    """A gripper's model.toml."""

    kind: Literal["gripper"]
    name: str
    description: str = ""
    mjcf: str
    joints: tuple[str, ...]
    locked: dict[str, Finite] = Field(default_factory=dict)
    pads: tuple[str, str]
    pad_geoms: tuple[str, ...]
    pad_radius: Positive
    approach_axis: Vector3
    closing_axis: Vector3
    postures: PosturesTable
    mount: MountTable
    limits: GripperLimitsTable
    pinch: PinchTable


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
        if not low - ROUNDING * high <= gap <= high + ROUNDING * high:
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


def read_gripper(path: str | Path) -> GripperModel:
    """Read a hand from its model.toml.

    Args:
        path: The TOML file; the MJCF that it names lies relative to it.

    Raises:
        ModelFileError: The file or the description is malformed, or the hand does not close between its postures.
    """
    path = Path(path)
    table = decode(GripperFile, read_toml(path), path)
    mjcf = path.parent / table.mjcf
    model = read_tree(mjcf, path, "mjcf")
    _check_joints(table, model, path)
    for i, pad in enumerate(table.pads):
        frame_id(model, pad, path, f"pads[{i}]")
    approach, closing = np.array(table.approach_axis), np.array(table.closing_axis)
    for key, axis in (("approach_axis", approach), ("closing_axis", closing)):
        if abs(np.linalg.norm(axis) - 1.0) > ROUNDING:
            raise ModelFileError(path, key, axis.tolist(), "a unit vector")
    if abs(approach @ closing) > ROUNDING:
        raise ModelFileError(path, "closing_axis", closing.tolist(), "perpendicular to the approach axis")
    _check_pad_geoms(table, model, mjcf, path)
    w, x, y, z = table.mount.quat_wxyz
    gripper = GripperModel(
        name=table.name,
        description=table.description,
        joint_names=table.joints,
        lower=np.deg2rad(table.limits.position_lower_deg),
        upper=np.deg2rad(table.limits.position_upper_deg),
        velocity=np.deg2rad(table.limits.velocity_deg_per_s),
        acceleration=np.deg2rad(table.limits.acceleration_deg_per_s2),
        torque=np.array(table.limits.torque_nm),
        T_flange_hand=pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.array(table.mount.position)),
        approach_axis=approach,
        closing_axis=closing,
        open_posture=np.array(table.postures.open),
        closed_posture=np.array(table.postures.closed),
        pads=table.pads,
        pad_geoms=table.pad_geoms,
        pad_radius=table.pad_radius,
        locked=dict(table.locked),
        pinch_force=table.pinch.force_n,
        pin_model=model,
        mjcf_path=mjcf,
    )
    _check_closing(gripper, path)
    return gripper


def _check_joints(table: GripperFile, model: pin.Model, path: Path) -> None:
    names = list(model.names)[1:]
    for key, given in (("joints", table.joints), ("locked", tuple(table.locked))):
        for name in given:
            if name not in names:
                raise ModelFileError(path, key, name, f"joints of the description: {names}")
    if len(set(table.joints)) != len(table.joints) or not table.joints:
        raise ModelFileError(path, "joints", list(table.joints), "at least one joint, each of them once")
    for name in names:
        if (name in table.joints) == (name in table.locked):
            raise ModelFileError(path, "locked", sorted(table.locked), f"joint {name!r} is either planned or locked")
    m = len(table.joints)
    for key in GripperLimitsTable.model_fields:
        require_length(getattr(table.limits, key), m, path, f"limits.{key}")
    for key in PosturesTable.model_fields:
        require_length(getattr(table.postures, key), m, path, f"postures.{key}")
    for i, (low, high) in enumerate(zip(table.limits.position_lower_deg, table.limits.position_upper_deg, strict=True)):
        if low >= high:
            raise ModelFileError(
                path, f"limits.position_lower_deg[{i}]", low, f"less than the upper limit {high} of {table.joints[i]!r}"
            )
        for key in PosturesTable.model_fields:
            angle = getattr(table.postures, key)[i]
            if not np.deg2rad(low) - ROUNDING <= angle <= np.deg2rad(high) + ROUNDING:
                raise ModelFileError(
                    path,
                    f"postures.{key}[{i}]",
                    angle,
                    f"within the limits of {table.joints[i]!r}, {low} to {high} deg",
                )
    for name, angle in table.locked.items():
        require_in_range(model, name, angle, path, f"locked.{name}")
    for key in ("position_lower_deg", "position_upper_deg"):
        for i, angle_deg in enumerate(getattr(table.limits, key)):
            require_in_range(model, table.joints[i], float(np.deg2rad(angle_deg)), path, f"limits.{key}[{i}]")


def _check_pad_geoms(table: GripperFile, model: pin.Model, mjcf: Path, path: Path) -> None:
    geometry = pin.buildGeomFromMJCF(model, str(mjcf), pin.GeometryType.COLLISION)
    known = [geom.name for geom in geometry.geometryObjects]
    for i, name in enumerate(table.pad_geoms):
        if name not in known:
            raise ModelFileError(path, f"pad_geoms[{i}]", name, f"a collision geom of the description: {known}")


def _check_closing(gripper: GripperModel, path: Path) -> None:
    gaps = [gripper.aperture(gripper.closing_posture(fraction)) for fraction in np.linspace(0.0, 1.0, 21)]
    # One posture for each gap, which `posture_for` relies on; it also catches swapped pads and swapped postures.
    if not (np.diff(gaps) < 0.0).all():
        raise ModelFileError(
            path,
            "postures",
            [round(gaps[0], 6), round(gaps[-1], 6)],
            "a gap between the pads that shrinks all the way from `open` to `closed`, the first pad on the side of "
            "the closing axis",
        )
