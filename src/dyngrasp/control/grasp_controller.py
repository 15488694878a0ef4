"""Arm and hand together: one command from one observation and one sample of the plan."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pinocchio as pin

from dyngrasp.control.computed_torque import ComputedTorque
from dyngrasp.control.gripper_control import GripperController
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array, Command, JointState, Observation
from dyngrasp.trajectory import PlanSample

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s²


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
        self.arm, self.hand = arm, hand
        self._model = robot.pin_model
        self._data = self._model.createData()
        self._flange, self._T_flange_hand = robot.tip_id, gripper.T_flange_hand

    def command(self, observation: Observation, sample: PlanSample) -> Command:
        """Torques of both for this control period."""
        return Command(
            self.arm.command(observation, sample),
            self.hand.command(observation, sample, self._specific_force(sample.arm)),
        )

    def _specific_force(self, arm: JointState) -> Array:
        """(3,) planned acceleration of the hand minus gravity, in hand axes (m/s²).

        An arm that accelerates by 10 m/s² bends an unprepared finger's position loop by 2 mm at the pad, which closes
        the pinch some 50 ms late.
        """
        pin.forwardKinematics(self._model, self._data, arm.position, arm.velocity, arm.acceleration)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        flange = pin.updateFramePlacement(self._model, self._data, self._flange)
        acceleration = pin.getFrameClassicalAcceleration(self._model, self._data, self._flange, world).linear
        return (flange.rotation @ self._T_flange_hand.rotation).T @ (acceleration - GRAVITY)
