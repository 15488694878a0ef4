"""Arm and hand as one tree with its collision geometry, for judging plans: full dynamics, distances, contacts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.errors import ModelFileError
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array


@dataclass(frozen=True, eq=False)
class Assembly:
    """The arm with the hand bolted to its flange; locked joints of the hand are fixed.

    Attributes:
        robot: The arm.
        gripper: The hand.
        pin_model: Arm joints, then the planned joints of the hand; armature included, payload of `robot` not.
        geometry: Collision geoms of both, with the names of their descriptions. No pairs are selected.
        arm_geoms: Names of the geoms of the arm.
        hand_geoms: Names of the geoms of the hand, pads among them.
        pad_geoms: Names of the geoms that may touch a part.
        arm_indices: (n,) where the arm joints are in a configuration.
        hand_indices: (m,) where the planned hand joints are, in the order of `gripper.joint_names`.
        flange_id: Frame of the flange in `pin_model`.
    """

    robot: RobotModel
    gripper: GripperModel
    pin_model: pin.Model
    geometry: pin.GeometryModel
    arm_geoms: tuple[str, ...]
    hand_geoms: tuple[str, ...]
    pad_geoms: tuple[str, ...]
    arm_indices: NDArray[np.intp]
    hand_indices: NDArray[np.intp]
    flange_id: int

    def configuration(self, q: Array, q_h: Array) -> Array:
        """(n + m,) configuration of `pin_model` at arm position q (n,) and hand posture q_h (m,).

        Velocities and accelerations are ordered alike: each joint has one of each.
        """
        both = np.empty(self.pin_model.nq)
        both[self.arm_indices], both[self.hand_indices] = q, q_h
        return both


def collision_geometry(model: pin.Model, description: Path) -> pin.GeometryModel:
    """Collision geoms of an MJCF or URDF description; meshes of a URDF lie relative to it.

    Raises:
        ModelFileError: A mesh cannot be read.
    """
    try:
        if description.suffix.lower() == ".urdf":
            return pin.buildGeomFromUrdf(
                model, str(description), pin.GeometryType.COLLISION, package_dirs=[str(description.parent)]
            )
        return pin.buildGeomFromMJCF(model, str(description), pin.GeometryType.COLLISION)
    except (RuntimeError, ValueError) as error:
        raise ModelFileError(description, None, None, f"collision geoms that can be read ({error})") from error


def assemble(robot: RobotModel, gripper: GripperModel) -> Assembly:
    """Bolt the hand to the arm's flange.

    Raises:
        ModelFileError: Arm and hand give the same name to two things, or collision geoms cannot be read.
    """
    description = robot.mjcf_path or robot.urdf_path
    assert description is not None  # `read_robot` sets exactly one of them
    arm_geometry = collision_geometry(robot.pin_model, description)
    hand_geometry = collision_geometry(gripper.pin_model, gripper.mjcf_path)
    arm_geoms = tuple(geom.name for geom in arm_geometry.geometryObjects)
    hand_geoms = tuple(geom.name for geom in hand_geometry.geometryObjects)
    _refuse_shared_names(robot, gripper, set(arm_geoms) & set(hand_geoms))

    whole, geometry = pin.appendModel(
        robot.pin_model, gripper.pin_model, arm_geometry, hand_geometry, robot.tip_id, gripper.T_flange_hand
    )
    # Pairs within one description and between both come along; which of them matter, the user of the geometry decides.
    geometry.removeAllCollisionPairs()
    at_lock = pin.neutral(whole)
    locked = []
    for name, angle in gripper.locked.items():
        joint = whole.getJointId(name)
        at_lock[whole.joints[joint].idx_q] = angle
        locked.append(joint)
    if locked:
        whole, geometry = pin.buildReducedModel(whole, geometry, locked, at_lock)
    # Neither of the two steps keeps the armature (Pinocchio 4.1).
    armature = np.zeros(whole.nv)
    for part in (robot.pin_model, gripper.pin_model):
        for joint in range(1, part.njoints):
            if whole.existJointName(part.names[joint]):
                at = whole.joints[whole.getJointId(part.names[joint])].idx_v
                armature[at] = part.armature[part.joints[joint].idx_v]
    whole.armature = armature

    def indices(names: tuple[str, ...]) -> NDArray[np.intp]:
        return np.array([whole.joints[whole.getJointId(name)].idx_q for name in names])

    return Assembly(
        robot=robot,
        gripper=gripper,
        pin_model=whole,
        geometry=geometry,
        arm_geoms=arm_geoms,
        hand_geoms=hand_geoms,
        pad_geoms=gripper.pad_geoms,
        arm_indices=indices(robot.joint_names),
        hand_indices=indices(gripper.joint_names),
        flange_id=frames_named(whole, robot.tip_frame)[0],
    )


def _refuse_shared_names(robot: RobotModel, gripper: GripperModel, geoms: set[str]) -> None:
    joints = set(robot.joint_names) & set(gripper.pin_model.names[1:])
    frames = {frame.name for frame in robot.pin_model.frames} & {frame.name for frame in gripper.pin_model.frames}
    shared = sorted((joints | frames | geoms) - {"universe"})
    if shared:
        raise ModelFileError(
            gripper.mjcf_path, None, None, f"names that {robot.name} does not use as well; both have {shared}"
        )
