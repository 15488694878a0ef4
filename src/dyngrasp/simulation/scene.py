"""The MuJoCo world: arm, hand, part and ground, composed from the files that the planner's models were read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.simulation.conveyor import CONVEYOR, Conveyor, ConveyorAddresses, add_conveyor, locate_conveyor
from dyngrasp.simulation.printed_sheet import PrintedSheet, add_sheet
from dyngrasp.simulation.stage import set_stage
from dyngrasp.simulation.variation import PlantVariation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mujoco import MjModel, MjSpec

    from dyngrasp.models.grasp_object import GraspObject
    from dyngrasp.models.gripper import GripperModel
    from dyngrasp.models.robot import RobotModel

ARM, HAND, PART, GROUND = "arm/", "hand/", "part", "ground"

IntArray = NDArray[np.int_]


@dataclass(frozen=True)
class SceneSettings:
    """Numerics of contact and integration, and the few physical facts that belong to no model file.

    Attributes:
        timestep: Step of the integration (s). 1 ms resolves contacts of `contact_time`; a faster control rate sets it
            lower.
        contact_time: Time constant of contacts (s), MuJoCo's solref. MuJoCo's own default of 20 ms lets a pinched part
            creep by 7 mm or drop; 3 ms is stiff enough and more than twice the step, as MuJoCo needs it.
        impratio: Stiffness of friction over that of normal contact; with elliptic cones, 20 stops the creep.
        ground_friction: Cast metal on the ground, and the hand's metal on anything.
        lock_stiffness: Of the servos that hold the joints which no plan moves (Nm/rad): geared motors in position mode.
        lock_torque: Their torque where the gripper's file states none (Nm).
    """

    timestep: float = 1e-3
    contact_time: float = 3e-3
    impratio: float = 20.0
    ground_friction: float = 0.5
    lock_stiffness: float = 100.0
    lock_torque: float = 2.1


@dataclass(frozen=True)
class Scene:
    """A compiled world and where in MuJoCo's arrays everything is.

    Attributes:
        model: Compiled model.
        settings: What it was built with.
        arm_qpos, arm_dof: (n,) addresses of the arm joints; also their motors are the first n actuators.
        gripper_qpos, gripper_dof: (m,) likewise of the planned gripper joints, actuators n … n+m−1.
        locked_qpos: (l,) addresses of the locked gripper joints, actuators n+m …
        locked_position: (l,) where they are held (rad).
        arm_torque_limit, gripper_torque_limit: (n,), (m,) what the motors can give (Nm).
        part_qpos, part_dof, part_body: Addresses of the part's free joint and its body.
        hand_body: Body whose frame is the hand frame.
        pad_geoms: (pads,) geoms that are meant to touch the part.
        pad_sites: (pads,) the gripper's pad frames.
        geom_kind: (ngeom,) 0 ground and what stands for it, 1 part, 2 pad, 3 the rest of the robot.
        conveyor: What carries the part, if anything does.
    """

    model: MjModel
    settings: SceneSettings
    arm_qpos: IntArray
    arm_dof: IntArray
    gripper_qpos: IntArray
    gripper_dof: IntArray
    locked_qpos: IntArray
    locked_position: NDArray[np.float64]
    arm_torque_limit: NDArray[np.float64]
    gripper_torque_limit: NDArray[np.float64]
    part_qpos: int
    part_dof: int
    part_body: int
    hand_body: int
    pad_geoms: IntArray
    pad_sites: IntArray
    geom_kind: IntArray
    conveyor: ConveyorAddresses | None = None


def build_scene(
    robot: RobotModel,
    gripper: GripperModel,
    grasp_object: GraspObject,
    variation: PlantVariation | None = None,
    settings: SceneSettings | None = None,
    *,
    markers: bool = False,
    conveyor: Conveyor | None = None,
    sheets: Sequence[PrintedSheet] = (),
) -> Scene:
    """Compose and compile the world.

    The robot's base is the world frame, the ground the plane z = 0, the part a free body.

    Args:
        robot: Bare arm.
        gripper: Mounted at the arm's tip by the gripper's mount transform.
        grasp_object: The part.
        variation: How this plant deviates from the models; nominal joint friction and the part's own
            friction if None.
        settings: Numerics.
        markers: Stick the part's markers on its faces, for cameras and pictures; they weigh and touch nothing.
        conveyor: What the part stands on, if not on the ground.
        sheets: What else is printed and lies in the world, such as a calibration board.

    Raises:
        ValueError: The variation is for another number of joints.
    """
    settings = settings or SceneSettings()
    if variation is None:
        variation = nominal_variation(robot, grasp_object)
    if variation.damping.size != robot.n:
        raise ValueError(f"the variation is for {variation.damping.size} joints, {robot.name} has {robot.n}")
    spec = mujoco.MjSpec()
    spec.modelname = f"{robot.name} with {gripper.name} and {grasp_object.name}"
    _set_numerics(spec, settings)
    set_stage(spec, GROUND, settings.ground_friction)
    _attach_robot(spec, robot, variation)
    _attach_gripper(spec, robot, gripper)
    _add_part(spec, grasp_object, variation)
    if markers:
        # Only here: whoever draws no markers needs no OpenCV.
        from dyngrasp.simulation.marker_stickers import add_stickers

        add_stickers(spec, spec.body(PART), grasp_object)
    for sheet in sheets:
        add_sheet(spec, spec.worldbody, sheet)
    _add_motors(spec, robot, gripper, settings)
    if conveyor is not None:
        add_conveyor(spec, conveyor, settings)
    _set_contacts(spec, gripper, variation, settings)
    return _locate(spec.compile(), settings, robot, gripper, conveyor)


def nominal_variation(robot: RobotModel, grasp_object: GraspObject) -> PlantVariation:
    """Nominal plant for an arm and a part: the friction that the part's file states."""
    friction = grasp_object.friction
    return PlantVariation.nominal(robot.n, friction=friction.sliding, torsional_friction=friction.torsional)


def _set_numerics(spec: MjSpec, settings: SceneSettings) -> None:
    spec.option.timestep = settings.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = settings.impratio
    # By default MuJoCo puts an unstable simulation back to its start and goes on: nothing here is teleported.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Inertia comes from the files alone: shapes drawn for the eye must not add any.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.compiler.degree = False


def _attach_robot(spec: MjSpec, robot: RobotModel, variation: PlantVariation) -> None:
    arm = mujoco.MjSpec.from_file(str(robot.mjcf_path or robot.urdf_path))
    spec.attach(arm, frame=spec.worldbody.add_frame(), prefix=ARM)
    for i, name in enumerate(robot.joint_names):
        joint = spec.joint(ARM + name)
        joint.armature = robot.pin_model.armature[i] * variation.armature_factors[i]
        joint.damping[0] += variation.damping[i]
        joint.frictionloss += variation.dry_friction[i]


def _attach_gripper(spec: MjSpec, robot: RobotModel, gripper: GripperModel) -> None:
    tip = spec.site(ARM + robot.tip_frame)
    if tip is not None:
        T_body_tip, body = _pose(tip.pos, tip.quat), tip.parent
    else:
        T_body_tip, body = pin.SE3.Identity(), spec.body(ARM + robot.tip_frame)
    position, quat_wxyz = _split(T_body_tip * gripper.T_flange_hand)
    mount = body.add_frame(pos=position, quat=quat_wxyz)
    spec.attach(mujoco.MjSpec.from_file(str(gripper.mjcf_path)), frame=mount, prefix=HAND)


def _add_part(spec: MjSpec, grasp_object: GraspObject, variation: PlantVariation) -> None:
    part = spec.worldbody.add_body(name=PART)
    part.add_freejoint(name=PART)
    inertia = grasp_object.spatial_inertia
    I = inertia.inertia * variation.mass_factor  # noqa: E741 — the symbol of the field
    part.explicitinertial = True
    part.mass = inertia.mass * variation.mass_factor
    part.ipos = inertia.lever
    part.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
    spec.add_material(name="cast_aluminium", rgba=[0.72, 0.73, 0.74, 1.0], specular=0.5, shininess=0.35)
    spec.add_mesh(
        name="part_visual", file=str(grasp_object.mesh_path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    )
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    part.add_geom(
        name="part_visual",
        type=mesh,
        meshname="part_visual",
        material="cast_aluminium",
        group=2,
        contype=0,
        conaffinity=0,
    )
    for k, path in enumerate(grasp_object.piece_paths):
        name = f"part_piece_{k}"
        spec.add_mesh(name=name, file=str(path), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        part.add_geom(name=name, type=mesh, meshname=name, group=3, rgba=[0.3, 0.6, 0.9, 0.4])


def _add_motors(spec: MjSpec, robot: RobotModel, gripper: GripperModel, settings: SceneSettings) -> None:
    """Torque motors for what is planned, position servos for what is locked."""
    motors = [
        *((ARM + name, limit) for name, limit in zip(robot.joint_names, robot.limits.torque, strict=True)),
        *((HAND + name, limit) for name, limit in zip(gripper.joint_names, gripper.torque, strict=True)),
    ]
    for name, limit in motors:
        # The controllers' torques are clipped by the plant; this range is the same limit once more, in the physics.
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.forcelimited, motor.forcerange = True, [-limit, limit]
    for name in gripper.locked:
        joint = spec.joint(HAND + name)
        low, high = joint.actfrcrange
        torque = high if high > low else settings.lock_torque
        servo = spec.add_actuator(name=HAND + name, target=HAND + name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=settings.lock_stiffness, dampratio=1.0)
        servo.forcelimited, servo.forcerange = True, [-torque, torque]


def _set_contacts(spec: MjSpec, gripper: GripperModel, variation: PlantVariation, settings: SceneSettings) -> None:
    solref = [settings.contact_time, 1.0]
    pads = {HAND + name for name in gripper.pad_geoms}
    for geom in spec.geoms:
        geom.solref = solref
        if geom.name in pads:
            # With priority, friction and dimension of a pad's contacts are the pad's own, whatever it touches. Four
            # dimensions: the rubber patch resists being turned about the contact normal, a point would not.
            geom.priority = 1
            geom.condim = 4
            geom.friction = [variation.friction, variation.torsional_friction, 1e-4]
        elif geom.name not in (GROUND, CONVEYOR):
            geom.condim = 3
            geom.friction = [settings.ground_friction, 0.005, 1e-4]
    _exclude_neighbours(spec)


def _exclude_neighbours(spec: MjSpec) -> None:
    """Shapes of links that share a joint, or a link between them, overlap by construction."""
    parents = {body.name: body.parent.name for body in spec.bodies if body.parent is not None and body.name != "world"}
    for name, parent in parents.items():
        if parent == "world":
            continue
        spec.add_exclude(bodyname1=name, bodyname2=parent)
        grandparent = parents.get(parent, "world")
        if grandparent != "world":
            spec.add_exclude(bodyname1=name, bodyname2=grandparent)


def _locate(
    model: MjModel, settings: SceneSettings, robot: RobotModel, gripper: GripperModel, conveyor: Conveyor | None
) -> Scene:
    def addresses(names: list[str]) -> tuple[IntArray, IntArray]:
        ids = [model.joint(name).id for name in names]
        return model.jnt_qposadr[ids].astype(int), model.jnt_dofadr[ids].astype(int)

    arm_qpos, arm_dof = addresses([ARM + name for name in robot.joint_names])
    gripper_qpos, gripper_dof = addresses([HAND + name for name in gripper.joint_names])
    locked_qpos, _ = addresses([HAND + name for name in gripper.locked])
    part_body = model.body(PART).id
    pad_geoms = np.array([model.geom(HAND + name).id for name in gripper.pad_geoms])
    kind = np.full(model.ngeom, 3)
    kind[model.geom_bodyid == part_body] = 1
    kind[model.geom(GROUND).id] = 0
    if conveyor is not None:
        kind[model.geom_bodyid == model.body(CONVEYOR).id] = 0
    kind[pad_geoms] = 2
    return Scene(
        model=model,
        settings=settings,
        arm_qpos=arm_qpos,
        arm_dof=arm_dof,
        gripper_qpos=gripper_qpos,
        gripper_dof=gripper_dof,
        locked_qpos=locked_qpos,
        locked_position=np.array(list(gripper.locked.values()), dtype=float),
        arm_torque_limit=np.array(robot.limits.torque, dtype=float),
        gripper_torque_limit=np.array(gripper.torque, dtype=float),
        part_qpos=int(model.joint(PART).qposadr[0]),
        part_dof=int(model.joint(PART).dofadr[0]),
        part_body=part_body,
        hand_body=_hand_body(model),
        pad_geoms=pad_geoms,
        pad_sites=np.array([model.site(HAND + name).id for name in gripper.pads]),
        geom_kind=kind,
        conveyor=None if conveyor is None else locate_conveyor(model, conveyor),
    )


def _hand_body(model: MjModel) -> int:
    """The first body of the gripper's file; its frame is the hand frame."""
    return next(i for i in range(model.nbody) if model.body(i).name.startswith(HAND))


def _pose(position: NDArray[np.float64], quat_wxyz: NDArray[np.float64]) -> pin.SE3:
    w, x, y, z = quat_wxyz
    return pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.array(position, dtype=float))


def _split(T: pin.SE3) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y, z, w = pin.Quaternion(T.rotation).coeffs()
    return np.array(T.translation), np.array([w, x, y, z])
