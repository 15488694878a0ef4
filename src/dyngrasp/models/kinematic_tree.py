"""Reading MJCF and URDF into Pinocchio, and what must hold of every tree before anything is computed with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from dyngrasp.errors import ModelFileError

ATTACHMENTS = (pin.FrameType.OP_FRAME, pin.FrameType.BODY)
"""Frames that a model file may name: sites of an MJCF, bodies and links; joints, which may share a name, are not."""

REVOLUTE = ("JointModelRX", "JointModelRY", "JointModelRZ", "JointModelRevoluteUnaligned")

ROUNDED_ANGLE = 1e-6  # rad

ROUNDED_MOMENTS = 1e-5
"""Part of the largest principal moment by which figures of six digits may miss the triangle inequality."""


def read_tree(description: Path, toml: Path, key: str) -> pin.Model:
    """Read a tree of revolute joints.

    Args:
        description: The MJCF or URDF file.
        toml: The model file that names it, for messages.
        key: The key it is named under, "mjcf" or "urdf".

    Returns:
        Inertias, placements, armature (MJCF only) and gravity; the root body is fixed to the world.

    Raises:
        ModelFileError: The file is missing or unreadable, has a joint that is not revolute with limits, a moving link
            without positive mass and inertia, or a number that is not finite.
    """
    if not description.is_file():
        raise ModelFileError(toml, key, description.name, f"a file that exists; there is no {description}")
    read = pin.buildModelFromMJCF if key == "mjcf" else pin.buildModelFromUrdf
    try:
        model = read(str(description))
    except (RuntimeError, ValueError) as error:
        raise ModelFileError(toml, key, description.name, f"a valid {key.upper()} file ({error})") from error
    check_tree(model, description, toml, key)
    return model


def check_tree(model: pin.Model, description: Path, toml: Path, key: str) -> None:
    """Refuse a tree that is not made of revolute joints and bodies that can exist.

    Raises:
        ModelFileError: As for `read_tree`.
    """

    def refuse(expected: str) -> ModelFileError:
        return ModelFileError(toml, key, description.name, expected)

    if model.njoints < 2:
        raise refuse("a description with at least one revolute joint; it has none")
    for joint, name, inertia, placement in zip(
        list(model.joints)[1:],
        list(model.names)[1:],
        list(model.inertias)[1:],
        list(model.jointPlacements)[1:],
        strict=True,
    ):
        if joint.shortname() not in REVOLUTE:
            raise refuse(
                f"revolute joints with limits only; joint {name!r} is {joint.shortname().removeprefix('JointModel')}"
            )
        numbers = np.concatenate([inertia.toDynamicParameters(), placement.translation, placement.rotation.ravel()])
        if not np.isfinite(numbers).all():
            raise refuse(f"finite numbers only; the link moved by joint {name!r} or its placement has another one")
        # A parser may drop an inertial element that it cannot read; then the mass is 0, which this finds as well.
        if inertia.mass <= 0.0:
            raise refuse(f"a mass > 0 for every moving link; the one moved by joint {name!r} has {inertia.mass:g} kg")
        moments = np.linalg.eigvalsh(inertia.inertia)
        smallest = float(moments[0])
        if smallest <= 0.0:
            raise refuse(
                f"a positive definite inertia for every moving link; the one moved by joint {name!r} has the "
                f"principal moment {smallest:g} kg m²"
            )
        if moments[0] + moments[1] < moments[2] * (1.0 - ROUNDED_MOMENTS):
            raise refuse(
                f"principal moments of which no one exceeds the sum of the others; those of the link moved by joint "
                f"{name!r} are {np.round(moments, 9).tolist()} kg m², which no body has"
            )
    if not np.isfinite(model.armature).all() or (model.armature < 0.0).any():
        raise refuse(f"armatures ≥ 0; they are {model.armature.tolist()}")


def require_chain(model: pin.Model, description: Path, toml: Path, key: str) -> None:
    """Refuse a tree that branches.

    Raises:
        ModelFileError: Some joint is carried by another than the one before it.
    """
    for i in range(1, model.njoints):
        if model.parents[i] != i - 1:
            raise ModelFileError(
                toml,
                key,
                description.name,
                f"one serial chain; joint {model.names[i]!r} branches off at {model.names[model.parents[i]]!r}",
            )


def frames_named(model: pin.Model, name: str) -> list[int]:
    """Indices of the sites, bodies and links of that name."""
    return [i for i, frame in enumerate(model.frames) if frame.name == name and frame.type in ATTACHMENTS]


def frame_id(model: pin.Model, name: str, toml: Path, key: str) -> int:
    """Index of a site, body or link.

    Raises:
        ModelFileError: There is no such frame; the message lists those there are.
    """
    found = frames_named(model, name)
    if len(found) != 1:
        known = sorted({frame.name for frame in model.frames if frame.type in ATTACHMENTS})
        raise ModelFileError(toml, key, name, f"the name of one site, body or link of the description: {known}")
    return found[0]


def require_length(values: tuple | None, length: int, toml: Path, key: str) -> None:
    """Refuse an array of another length than `length`.

    Raises:
        ModelFileError: It has another length.
    """
    if values is not None and len(values) != length:
        raise ModelFileError(toml, key, list(values), f"{length} numbers, one for each joint")


def require_in_range(model: pin.Model, joint: str, angle: float, toml: Path, key: str) -> None:
    """Refuse an angle (rad) outside the range that the description gives the joint.

    Raises:
        ModelFileError: It is outside by more than angles written with six decimals may be.
    """
    i = model.joints[model.getJointId(joint)].idx_q
    low, high = model.lowerPositionLimit[i], model.upperPositionLimit[i]
    if not low - ROUNDED_ANGLE <= angle <= high + ROUNDED_ANGLE:
        raise ModelFileError(
            toml, key, angle, f"within the range of joint {joint!r} in the description, {low:.6g} to {high:.6g} rad"
        )
