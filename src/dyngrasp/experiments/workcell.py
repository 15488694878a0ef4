"""What the names in a scenario stand for: models loaded, start and target checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngrasp.errors import ScenarioError
from dyngrasp.experiments.scenario import Scenario
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.catalogue import load_camera, load_gripper, load_object, load_robot
from dyngrasp.models.robot import RobotModel
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.signals import Array, read_only


@dataclass(frozen=True)
class Workcell:
    """A scenario with its models.

    Attributes:
        scenario: As it was decoded.
        task: Arm, gripper, part, target configuration and settings.
        q_start: (n,) configuration in which the motion begins (rad).
        camera: On the hand, with pictures of the size that the scenario asks for.
    """

    scenario: Scenario
    task: GraspTask
    q_start: Array
    camera: CameraModel


def load_workcell(scenario: Scenario, source: str | Path) -> Workcell:
    """Load the models that a scenario names and check start and target against the arm.

    Args:
        scenario: Decoded scenario.
        source: The file it came from; it is only named in errors.

    Raises:
        UnknownName: A name that the catalogue does not hold.
        ModelFileError: A model file that cannot be used.
        ScenarioError: Start or target with the wrong number of joints, or outside the limits.
    """
    section = scenario.task
    robot = load_robot(section.robot)
    gripper = load_gripper(section.gripper)
    grasp_object = load_object(section.object)
    q_start = _configuration(section.start_deg, "task.start_deg", robot, source)
    place = _configuration(section.place_deg, "task.place_deg", robot, source)
    task = GraspTask(robot, gripper, grasp_object, place, section.task_settings)
    camera = load_camera(scenario.camera.model)
    if scenario.camera.width is not None and scenario.camera.height is not None:
        camera = camera.scaled(scenario.camera.width, scenario.camera.height)
    return Workcell(scenario, task, q_start, camera)


def _configuration(degrees: tuple[float, ...], key: str, robot: RobotModel, source: str | Path) -> Array:
    if len(degrees) != robot.n:
        raise ScenarioError(
            source, key, list(degrees), f"{robot.name} has {robot.n} joints, so {robot.n} angles are expected"
        )
    lower, upper = np.rad2deg(robot.limits.position_lower), np.rad2deg(robot.limits.position_upper)
    for i, (value, low, high) in enumerate(zip(degrees, lower, upper, strict=True)):
        # Both sides went through a conversion of units; that rounding is no offence.
        if not low - 1e-9 <= value <= high + 1e-9:
            raise ScenarioError(
                source,
                f"{key}[{i}]",
                value,
                f"outside the limits of joint {robot.joint_names[i]}: {low:g} to {high:g} degrees",
            )
    return read_only(np.deg2rad(degrees))
