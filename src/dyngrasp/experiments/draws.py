"""What chance decides in a trial: where the part lies, how wrong its pose is, how the plant deviates.

Every trial has a seed of its own, drawn from the study's, so that a row of a study is repeated by
`dyngrasp run --seed` and does not depend on how many trials or processes there were. Each quantity draws from its own
stream: switching pose errors on leaves the parts where they were.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.scenario import ConveyorSection, PlantSection, PoseSection, RelocationSection
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.models.grasp_object import GraspObject
from dyngrasp.signals import Array
from dyngrasp.simulation.conveyor import Conveyor, standing_on
from dyngrasp.simulation.variation import PlantVariation


@dataclass(frozen=True)
class Trial:
    """One draw.

    Attributes:
        seed: Reproduces it.
        T_world_object: Where the part is.
        T_world_object_believed: Where the planner is told that it is; None if the camera has to find it.
        variation: What the planner does not know about the plant.
        twist_world: (6,) velocity of the part at first (m/s, rad/s), world axes.
        twist_believed: (6,) what the planner is told of it, if it is told anything.
        conveyor: What the part stands on, if not on the ground.
    """

    seed: int
    T_world_object: pin.SE3
    T_world_object_believed: pin.SE3 | None
    variation: PlantVariation
    twist_world: Array
    twist_believed: Array
    conveyor: Conveyor | None


def trial_seed(study_seed: int, index: int) -> int:
    """Seed of trial `index` ≥ 0 of a study: below 2**53, so that it survives as a number in JSON."""
    words = np.random.SeedSequence(study_seed, spawn_key=(index,)).generate_state(1, np.uint64)
    return int(words[0]) >> 11


def draw_trial(workcell: Workcell, seed: int) -> Trial:
    """Draw the trial that belongs to a seed."""
    scenario, grasp_object = workcell.scenario, workcell.task.grasp_object
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
    part_rng, pose_rng, plant_rng, conveyor_rng, relocation_rng = streams
    part = scenario.part
    x, y = part_rng.uniform(*part.x_m), part_rng.uniform(*part.y_m)
    yaw = np.deg2rad(part_rng.uniform(*part.yaw_deg))
    z = part_rng.uniform(*part.z_m) if part.z_m is not None else grasp_object.rest_height
    T_world_object = pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, z]))
    twist, twist_believed = _twists(scenario.conveyor, conveyor_rng)
    conveyor = None
    if twist.any():
        conveyor = Conveyor(twist[:2], T_world_object.translation[:2])
    elif scenario.relocation is not None:
        conveyor = _relocation(scenario.relocation, T_world_object.translation[:2], relocation_rng)
    if conveyor is not None:
        T_world_object = standing_on(conveyor, T_world_object)
    return Trial(
        seed=seed,
        T_world_object=T_world_object,
        T_world_object_believed=_believed(T_world_object, grasp_object, scenario.pose, pose_rng),
        variation=_variation(scenario.plant, workcell.task.robot.n, plant_rng),
        twist_world=twist,
        twist_believed=twist_believed,
        conveyor=conveyor,
    )


def _twists(section: ConveyorSection | None, rng: np.random.Generator) -> tuple[Array, Array]:
    """Velocity of the part, true and believed, each (6,)."""
    true = np.zeros(6)
    if section is None:
        return true, true
    speed, heading = rng.uniform(*section.speed_m_s), np.deg2rad(rng.uniform(*section.heading_deg))
    true[:2] = speed * np.array([np.cos(heading), np.sin(heading)])
    return true, (1.0 + section.speed_error * rng.uniform(-1.0, 1.0)) * true


def _relocation(section: RelocationSection, centre: Array, rng: np.random.Generator) -> Conveyor:
    """The plate that moves the part away."""
    distance, heading = 1e-3 * rng.uniform(*section.distance_mm), np.deg2rad(rng.uniform(*section.heading_deg))
    at = rng.uniform(*section.at_s)
    velocity = distance / section.within_s * np.array([np.cos(heading), np.sin(heading)])
    return Conveyor(velocity, centre, length=0.4, width=0.4, run=(at, at + section.within_s))


def _believed(
    T_world_object: pin.SE3, part: GraspObject, pose: PoseSection, rng: np.random.Generator
) -> pin.SE3 | None:
    """The true pose, displaced in the grasp frame: what the fingers feel, wherever the part's origin lies."""
    if pose.source == "camera":
        return None
    # All draws are made whatever the settings: those of one setting must not shift the others'.
    signs = rng.choice([-1.0, 1.0], 3)
    offset = 1e-3 * np.array([pose.along_mm, pose.across_mm, pose.up_mm]) * (signs if pose.random_sign else 1.0)
    # The cube root makes the ball's volume uniform.
    ball = _direction(rng) * rng.uniform() ** (1 / 3)
    turn = _direction(rng) * rng.uniform()
    heading, side = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    if pose.source != "truth" and pose.draw == "planar":
        R_grasp = (T_world_object * part.grasps[0].T_object_grasp).rotation
        offset = offset + 1e-3 * pose.position_mm * (R_grasp.T @ np.array([np.cos(heading), np.sin(heading), 0.0]))
        turn = side * np.deg2rad(pose.rotation_deg) * R_grasp[2]
    elif pose.source != "truth":
        offset = offset + 1e-3 * pose.position_mm * ball
        turn = np.deg2rad(pose.rotation_deg) * turn
    else:
        turn = np.zeros(3)
    T_object_grasp = part.grasps[0].T_object_grasp
    error = pin.SE3(pin.exp3(turn), offset)
    return T_world_object * T_object_grasp * error * T_object_grasp.inverse()


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _variation(plant: PlantSection, joints: int, rng: np.random.Generator) -> PlantVariation:
    return PlantVariation.draw(
        rng,
        joints,
        friction_range=plant.friction,
        torsional_over_sliding=plant.torsional_over_sliding_m,
        mass_spread=plant.mass_spread,
        armature_spread=plant.armature_spread,
        joint_friction_spread=plant.joint_friction_spread,
    )
