"""What an audit evaluates plans with: arrays of the arm empty and loaded, frames of the hand, limits."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.models.assembly import assemble
from dyngrasp.models.batch_dynamics import Attachments, BatchModel
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.models.pinch import Pinch
from dyngrasp.planning.audit_rows import bounds_of
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.signals import Array, read_only

Pose = tuple[Array, Array]
"""Rotation (3, 3) and position (3,) (m)."""


class Hand(NamedTuple):
    """Where the hand is.

    Attributes:
        arm_indices, hand_indices: Where the joints of arm and hand are in their tree.
        tree: Of `BatchModel`.
        frames: Of `Attachments`: a frame of the hand, turned like the grasp, and those of both pads.
    """

    arm_indices: NDArray[np.int64]
    hand_indices: NDArray[np.int64]
    tree: tuple[NDArray[np.int64], Array, Array]
    frames: tuple[NDArray[np.int64], Array, Array]


class Held(NamedTuple):
    """The part in the hand, in the frame of the arm's last link.

    Attributes:
        mass: kg.
        first_moment: (3,) mass times centre of mass (kg m).
        inertia: (3, 3) about the origin of the link (kg m²).
        grasp: Where the grasp frame is.
        pinch: How the pads hold it.
    """

    mass: float
    first_moment: Array
    inertia: Array
    grasp: Pose
    pinch: Pinch


class PlanModels(NamedTuple):
    """What does not change from plan to plan, as compiled code takes it.

    Attributes:
        grasp_on_part: The grasp frame in the part's.
        arm_boxes, gripper_boxes: Middles and half-widths (3, n) of the ranges of position, velocity and acceleration.
        torque: (n,) limits (Nm).
        empty: `BatchModel.chain` of the arm with nothing in its hand.
        carried: Mass (kg), first moment (3,) (kg m) and inertia (3, 3) (kg m²) that its last link has more with the
            part in the closed hand.
        hand: Where the hand is.
        reach: How far G can be from any joint, at most (m).
        held: The part in it.
        funnel: σ_x, σ_y and z_th of eq. (5) (m).
        pregrasp: How far above the grasp frame the approach ends (m).
        bounds: Of `ROWS`.
    """

    grasp_on_part: Pose
    arm_boxes: tuple[Array, Array]
    gripper_boxes: tuple[Array, Array]
    torque: Array
    empty: tuple[Array, ...]
    carried: tuple[float, Array, Array]
    hand: Hand
    reach: float
    held: Held
    funnel: tuple[float, float, float]
    pregrasp: float
    bounds: tuple[float, ...]


@lru_cache(maxsize=8)
def plan_models(task: GraspTask, grasp_name: str) -> PlanModels:
    """The models of a task whose part is taken by the grasp of that name, made once."""
    grasp = next(grasp for grasp in task.grasp_object.grasps if grasp.name == grasp_name)
    robot, part, settings, gripper = task.robot, task.grasp_object, task.settings, task.gripper
    limits, funnel = robot.limits, part.funnel
    loaded = BatchModel.from_pinocchio(task.robot_loaded(grasp).loaded_model)
    empty = BatchModel.from_pinocchio(task.robot_empty.loaded_model)
    assembly = assemble(robot, gripper)
    tree = BatchModel.from_pinocchio(assembly.pin_model)
    frames = _frames(tree, assembly.pin_model, assembly.flange_id, task)
    T_object_grasp = grasp.T_object_grasp
    in_link = loaded.attach([(robot.n, robot.T_last_flange * task.T_flange_closed(grasp))])
    body = (pin.SE3(in_link.rotations[0], in_link.positions[0]) * T_object_grasp.inverse()).act(part.spatial_inertia)
    return PlanModels(
        grasp_on_part=(read_only(T_object_grasp.rotation), read_only(T_object_grasp.translation)),
        arm_boxes=_boxes(limits.position_lower, limits.position_upper, limits.velocity, limits.acceleration),
        gripper_boxes=_boxes(gripper.lower, gripper.upper, gripper.velocity, gripper.acceleration),
        torque=read_only(limits.torque),
        empty=empty.chain,
        # What the hand carries changes the inertia of the last link and nothing else.
        carried=(
            float(loaded.mass[-1] - empty.mass[-1]),
            read_only(loaded.first_moment[-1] - empty.first_moment[-1]),
            read_only(loaded.inertia[-1] - empty.inertia[-1]),
        ),
        hand=Hand(assembly.arm_indices, assembly.hand_indices, tree.tree, frames.arrays),
        reach=float(np.linalg.norm(tree.offsets, axis=1).sum() + np.linalg.norm(frames.positions, axis=1).max()),
        held=Held(
            float(body.mass),
            read_only(body.mass * body.lever),
            read_only(body.matrix()[3:, 3:]),
            (in_link.rotations[0], in_link.positions[0]),
            Pinch(*(float(x) for x in task.pinch(grasp))),
        ),
        funnel=(float(funnel.sigma_x), float(funnel.sigma_y), float(funnel.z_threshold)),
        pregrasp=float(settings.pregrasp_distance),
        bounds=bounds_of(
            float(settings.lateral_tolerance), float(settings.dip_tolerance), float(settings.tilt_tolerance)
        ),
    )


def _frames(tree: BatchModel, model: pin.Model, flange_id: int, task: GraspTask) -> Attachments:
    pads = (frames_named(model, name)[0] for name in task.gripper.pads)
    frames = [model.frames[i] for i in (flange_id, *pads)]
    (flange, T), *fingers = [(int(frame.parentJoint), pin.SE3(frame.placement)) for frame in frames]
    # The axes of the pinch are those of the hand; only its origin depends on the fingers.
    return tree.attach([(flange, T * task.T_flange_open), *fingers])


def _boxes(lower: Array, upper: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array]:
    zero = np.zeros_like(velocity)
    return read_only([(upper + lower) / 2, zero, zero]), read_only([(upper - lower) / 2, velocity, acceleration])
