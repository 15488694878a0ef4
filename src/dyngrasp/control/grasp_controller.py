"""Arm and hand together: one command from one observation and one sample of the plan."""

from __future__ import annotations

from typing import Protocol

from dyngrasp.control.computed_torque import ComputedTorque
from dyngrasp.control.gripper_control import GripperController
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Command, Observation
from dyngrasp.trajectory import PlanSample


class Controller(Protocol):
    """Turns what is measured and what is planned into torques, once a control period."""

    def command(self, observation: Observation, sample: PlanSample) -> Command:
        """Torques for this control period."""
        ...


class GraspController:
    """Computed torque for the arm, position then force for the hand.

    Args:
        robot: Any model of the arm; only its kinematics is used here.
        gripper: The hand.
        arm: Controller of the arm.
        hand: Controller of the hand.
    """

    def __init__(self, robot: RobotModel, gripper: GripperModel, arm: ComputedTorque, hand: GripperController) -> None:
        self._robot, self._gripper = robot, gripper
        self.arm, self.hand = arm, hand

    def command(self, observation: Observation, sample: PlanSample) -> Command:
        """Torques of both for this control period."""
        T_world_hand = self._robot.forward_kinematics(observation.arm_position) * self._gripper.T_flange_hand
        return Command(
            self.arm.command(observation, sample),
            self.hand.command(observation, sample, T_world_hand.rotation),
        )
