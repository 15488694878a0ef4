"""A hand read from its model.toml, and what must hold of the file and of the description that it names."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from pydantic import Field

from dyngrasp.errors import ModelFileError
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.kinematic_tree import frame_id, read_tree, require_in_range, require_length
from dyngrasp.models.model_file import Finite, PoseTable, Positive, StrictSchema, Vector3, decode, read_toml

ROUNDING = 1e-6  # rad and unitless: numbers written with six decimals agree to this


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
    """A gripper's model.toml. `mount` is the hand frame in the robot's flange frame."""

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
    mount: PoseTable
    limits: GripperLimitsTable
    pinch: PinchTable


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
    gripper = GripperModel(
        name=table.name,
        description=table.description,
        joint_names=table.joints,
        lower=np.deg2rad(table.limits.position_lower_deg),
        upper=np.deg2rad(table.limits.position_upper_deg),
        velocity=np.deg2rad(table.limits.velocity_deg_per_s),
        acceleration=np.deg2rad(table.limits.acceleration_deg_per_s2),
        torque=np.array(table.limits.torque_nm),
        T_flange_hand=table.mount.pose,
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
