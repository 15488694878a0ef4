"""The arm: kinematics, dynamics and limits of one serial chain of revolute joints, with what it carries."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from dyngrasp.errors import ModelFileError
from dyngrasp.models.flange_chain import FlangeChain
from dyngrasp.models.kinematic_tree import frame_id, frames_named, read_tree, require_chain, require_length
from dyngrasp.models.limits import JointLimits
from dyngrasp.models.model_file import Finite, NonNegative, Positive, StrictSchema, decode, read_toml
from dyngrasp.signals import Array

RANGE_ROUNDING = 1e-6  # rad: a range written in degrees with six decimals against the same in radians


class SrsLengths(StrictSchema):
    """Offsets (m) of an arm with spherical shoulder, revolute elbow and spherical wrist, along the stretched arm."""

    base_to_shoulder: NonNegative
    shoulder_to_elbow: Positive
    elbow_to_wrist: Positive
    wrist_to_flange: NonNegative


class LimitsTable(StrictSchema):
    """The table `[limits]` of a robot's model.toml: one entry a joint, from the base on."""

    position_lower_deg: tuple[Finite, ...]
    position_upper_deg: tuple[Finite, ...]
    velocity_deg_per_s: tuple[Positive, ...]
    torque_nm: tuple[Positive, ...]
    acceleration_deg_per_s2: tuple[Positive, ...] | None = None
    coriolis_bound_nm: tuple[NonNegative, ...] | None = None


class RobotFile(StrictSchema):
    """A robot's model.toml.

    Exactly one of `mjcf` and `urdf` names the description, relative to the file. MJCF states the armature itself; a
    URDF cannot, so there `armature_kg_m2` gives it.
    """

    kind: Literal["robot"]
    name: str
    description: str = ""
    mjcf: str | None = None
    urdf: str | None = None
    tip_frame: str
    kinematics: Literal["srs", "general"] = "general"
    srs: SrsLengths | None = None
    armature_kg_m2: tuple[NonNegative, ...] | None = None
    limits: LimitsTable


@dataclass(frozen=True, eq=False)
class RobotModel:
    """An arm and what is rigidly attached to its flange. World frame and robot base frame are the same.

    Attributes:
        name: As in the model file.
        description: One line for people.
        limits: Joint limits.
        pin_model: The bare arm, armature included; not to be changed.
        tip_frame: Name of the flange frame in `pin_model`.
        kinematics: "srs" if the closed form for such arms applies, with its lengths in `srs`, else "general".
        srs: Lengths of the S-R-S chain, or None.
        payload: Inertia of what the flange carries, in the flange frame.
        mjcf_path: The MJCF description, None if the arm was read from URDF.
        urdf_path: The URDF description, None if the arm was read from MJCF.
    """

    name: str
    description: str
    limits: JointLimits
    pin_model: pin.Model
    tip_frame: str
    kinematics: Literal["srs", "general"]
    srs: SrsLengths | None
    mjcf_path: Path | None
    urdf_path: Path | None
    payload: pin.Inertia = field(default_factory=pin.Inertia.Zero)
    # Functions of the bare arm, built on first use; the payload is their argument, so loaded copies share them.
    symbolic_cache: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.pin_model.nv

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints from the base to the flange."""
        return tuple(self.pin_model.names)[1:]

    @cached_property
    def tip_id(self) -> int:
        """Index of the flange frame in `pin_model`."""
        return frames_named(self.pin_model, self.tip_frame)[0]

    @property
    def T_last_flange(self) -> pin.SE3:
        """Flange frame in the frame of the last joint."""
        return self.pin_model.frames[self.tip_id].placement

    @cached_property
    def loaded_model(self) -> pin.Model:
        """The arm with its payload lumped into the last link; not to be changed."""
        model = pin.Model(self.pin_model)
        model.inertias[self.n] += self.T_last_flange.act(self.payload)
        return model

    @cached_property
    def _data(self) -> pin.Data:
        return self.loaded_model.createData()

    @cached_property
    def flange_chain(self) -> FlangeChain:
        """Kinematics of the flange for compiled code and for cycles that count microseconds."""
        return FlangeChain.from_pinocchio(self.pin_model, self.T_last_flange)

    @cached_property
    def mass(self) -> float:
        """Mass (kg) of the bare arm including the fixed base."""
        return float(sum(inertia.mass for inertia in self.pin_model.inertias))

    def with_payload(self, inertia: pin.Inertia) -> RobotModel:
        """The same arm carrying more.

        Args:
            inertia: Of the added body, in the flange frame; it adds to the payload there is.
        """
        return replace(self, payload=self.payload + inertia)

    def forward_kinematics(self, q: Array) -> pin.SE3:
        """T_world_flange at joint positions q (n,)."""
        pin.forwardKinematics(self.loaded_model, self._data, np.asarray(q, dtype=float))
        return pin.SE3(pin.updateFramePlacement(self.loaded_model, self._data, self.tip_id))

    def jacobian(self, q: Array) -> Array:
        """(6, n) Jacobian of the flange origin: three linear rows (m), then three angular ones, in world axes."""
        return pin.computeFrameJacobian(
            self.loaded_model, self._data, np.asarray(q, dtype=float), self.tip_id, pin.LOCAL_WORLD_ALIGNED
        ).copy()

    def mass_matrix(self, q: Array) -> Array:
        """M(q), (n, n) in kg m², with armature and payload."""
        upper = np.triu(pin.crba(self.loaded_model, self._data, np.asarray(q, dtype=float)))
        return upper + np.triu(upper, 1).T

    def gravity_torque(self, q: Array) -> Array:
        """g(q), (n,) in Nm: what holds the arm still."""
        return pin.computeGeneralizedGravity(self.loaded_model, self._data, np.asarray(q, dtype=float)).copy()

    def inverse_dynamics(self, q: Array, w: Array, v: Array) -> Array:
        """M(q) v + C(q, w) w + g(q), (n,) in Nm, for velocities w = q̇ and accelerations v = q̈, all (n,)."""
        arguments = (np.asarray(x, dtype=float) for x in (q, w, v))
        return pin.rnea(self.loaded_model, self._data, *arguments).copy()

    def bias_torque(self, q: Array, w: Array) -> Array:
        """C(q, w) w, (n,) in Nm: Coriolis and centrifugal torques without gravity."""
        q, w = np.asarray(q, dtype=float), np.asarray(w, dtype=float)
        both = pin.nonLinearEffects(self.loaded_model, self._data, q, w).copy()
        return both - pin.computeGeneralizedGravity(self.loaded_model, self._data, q)


def read_robot(path: str | Path) -> RobotModel:
    """Read an arm from its model.toml.

    Args:
        path: The TOML file; the MJCF or URDF that it names lies relative to it.

    Raises:
        ModelFileError: The file or the description is malformed, or is not one serial chain of revolute joints that
            ends in the tip frame.
    """
    path = Path(path)
    table = decode(RobotFile, read_toml(path), path)
    if (table.mjcf is None) == (table.urdf is None):
        raise ModelFileError(path, "mjcf", table.mjcf, "exactly one of the keys `mjcf` and `urdf`")
    key = "mjcf" if table.mjcf is not None else "urdf"
    description = path.parent / str(table.mjcf or table.urdf)
    model = read_tree(description, path, key)
    require_chain(model, description, path, key)
    tip = model.frames[frame_id(model, table.tip_frame, path, "tip_frame")]
    if tip.parentJoint != model.njoints - 1:
        raise ModelFileError(
            path, "tip_frame", table.tip_frame, f"a frame behind the last joint, {model.names[model.njoints - 1]!r}"
        )
    _check_kinematics(table, model, path)
    if table.armature_kg_m2 is not None:
        if key == "mjcf":
            raise ModelFileError(
                path, "armature_kg_m2", list(table.armature_kg_m2), "no such key: MJCF states it itself"
            )
        require_length(table.armature_kg_m2, model.nv, path, "armature_kg_m2")
        model.armature = np.array(table.armature_kg_m2)
    return RobotModel(
        name=table.name,
        description=table.description,
        limits=_limits(table.limits, model, path),
        pin_model=model,
        tip_frame=table.tip_frame,
        kinematics=table.kinematics,
        srs=table.srs,
        mjcf_path=description if key == "mjcf" else None,
        urdf_path=description if key == "urdf" else None,
    )


def _check_kinematics(table: RobotFile, model: pin.Model, path: Path) -> None:
    if table.kinematics == "general":
        if table.srs is not None:
            raise ModelFileError(path, "srs", None, 'no such table unless kinematics = "srs"')
        return
    if table.srs is None:
        raise ModelFileError(path, "srs", None, 'the four lengths that kinematics = "srs" needs')
    if model.nv != 7:
        raise ModelFileError(path, "kinematics", "srs", f'"general": an S-R-S arm has 7 joints, this one {model.nv}')
    lengths = table.srs
    total = lengths.base_to_shoulder + lengths.shoulder_to_elbow + lengths.elbow_to_wrist + lengths.wrist_to_flange
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.zeros(7))
    height = data.oMf[frame_id(model, table.tip_frame, path, "tip_frame")].translation
    # The closed form rests on the lengths, the audit on the description: they must agree to well below a millimetre.
    if not np.allclose(height, [0.0, 0.0, total], atol=1e-6):
        raise ModelFileError(
            path,
            "srs",
            total,
            f"lengths that add up to the flange position at q = 0, which is {height.round(7).tolist()} m",
        )


def _limits(table: LimitsTable, model: pin.Model, path: Path) -> JointLimits:
    for key in LimitsTable.model_fields:
        require_length(getattr(table, key), model.nv, path, f"limits.{key}")
    lower, upper = np.deg2rad(table.position_lower_deg), np.deg2rad(table.position_upper_deg)
    for i, name in enumerate(tuple(model.names)[1:]):
        if lower[i] >= upper[i]:
            raise ModelFileError(
                path,
                f"limits.position_lower_deg[{i}]",
                table.position_lower_deg[i],
                f"less than the upper limit {table.position_upper_deg[i]} of joint {name!r}",
            )
        for side, value, outside in (
            ("lower", lower[i], model.lowerPositionLimit[i] - lower[i]),
            ("upper", upper[i], upper[i] - model.upperPositionLimit[i]),
        ):
            if outside > RANGE_ROUNDING:
                low, high = np.rad2deg([model.lowerPositionLimit[i], model.upperPositionLimit[i]])
                raise ModelFileError(
                    path,
                    f"limits.position_{side}_deg[{i}]",
                    round(float(np.rad2deg(value)), 6),
                    f"within the range of joint {name!r} in the description, {low:.6g} to {high:.6g}",
                )
    acceleration = table.acceleration_deg_per_s2
    coriolis = table.coriolis_bound_nm
    for i, bound in enumerate(coriolis or ()):
        if bound >= table.torque_nm[i]:
            raise ModelFileError(
                path, f"limits.coriolis_bound_nm[{i}]", bound, f"less than the torque limit {table.torque_nm[i]}"
            )
    return JointLimits(
        position_lower=lower,
        position_upper=upper,
        velocity=np.deg2rad(table.velocity_deg_per_s),
        torque=np.array(table.torque_nm),
        acceleration=np.array(np.inf) if acceleration is None else np.deg2rad(acceleration),
        coriolis=np.array(0.0 if coriolis is None else coriolis),
    )
