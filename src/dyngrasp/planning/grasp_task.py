"""What is to be done: which arm and gripper take which part and where to, and how it is approached and lifted."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import Grasp, GraspObject
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.inverse_kinematics import InverseKinematics, inverse_kinematics_for
from dyngrasp.models.pinch import Pinch
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array, read_only

# Without these there is no approach, no pinch, or no room at all to move in.
_POSITIVE = (
    "pregrasp_distance",
    "grasp_duration_min",
    "grip_share",
    "lateral_tolerance",
    "dip_tolerance",
    "tilt_tolerance",
)


@dataclass(frozen=True)
class TaskSettings:
    """How a part is approached, pinched and lifted.

    All numbers are finite and ≥ 0.

    Attributes:
        pregrasp_distance: Height of G above the grasp frame where the approach ends (m; the paper draws about 20 mm).
        approach_speed: Speed of G along the approach axis at the pre-grasp (m/s).
        lift_speed: Speed of the closed hand along world z at the end of the grasp (m/s), ≥ 0 by eq. (7).
        swivel_rate: Least arm-angle rate through both ends of the grasp (rad/s). The reversal from approach to lift
            would stop every joint at the same instant; a redundant arm keeps moving by this null-space motion.
        swivel_speed_ratio: Least max-norm of q̇/q̇max that the null-space motion alone must give; raises the swivel
            rate where the arm's posture makes it slow.
        grasp_duration_min, grasp_duration_max: Bounds on ΔT_2 (s). Longer reversals overshoot below the grasp
            frame, and the fingers would clamp there.
        over_close: How much narrower than the part the planned closed gap is (m), so that contact comes before the
            lift and the position loop already presses when the force ramp begins.
        side_clearance_min: Least free gap on either side of the part with the gripper open (m).
        grip_share: Part of the finger force that the hand presses with; the rest is left to its position loop, which
            keeps the part from moving sideways.
        holding_safety: Factor by which the pinch must exceed what the part asks of it (torsion and friction).
        lateral_tolerance, dip_tolerance: How far G may leave the grasp axis, and pass below the grasp frame, while the
            hand closes (m).
        tilt_tolerance: How far the hand may tilt against the grasp frame while it closes (rad).
        limit_margin: Distance that grasp postures keep from the joint limits (rad).
        dexterity_min: Least singular value of the Jacobian (translation in m/rad) at a grasp posture.
    """

    pregrasp_distance: float = 0.020
    approach_speed: float = 0.05
    lift_speed: float = 0.03
    swivel_rate: float = 0.06
    swivel_speed_ratio: float = 0.03
    grasp_duration_min: float = 0.5
    grasp_duration_max: float = 0.8
    over_close: float = 0.001
    side_clearance_min: float = 0.010
    grip_share: float = 0.8
    holding_safety: float = 2.0
    lateral_tolerance: float = 0.0015
    dip_tolerance: float = 0.003
    tilt_tolerance: float = np.deg2rad(1.0)
    limit_margin: float = np.deg2rad(5.0)
    dexterity_min: float = 0.04

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (np.isfinite(value) and (value > 0 or (value == 0 and item.name not in _POSITIVE))):
                bound = "> 0" if item.name in _POSITIVE else "≥ 0"
                raise InvalidProblem(f"{item.name} must be a number {bound}, got {value}")
        if self.grip_share > 1:
            raise InvalidProblem(f"grip_share must be at most 1, got {self.grip_share}")
        if self.grasp_duration_min > self.grasp_duration_max:
            raise InvalidProblem(
                f"grasp_duration_min must be at most grasp_duration_max, got {self.grasp_duration_min} s and "
                f"{self.grasp_duration_max} s"
            )


@dataclass(frozen=True, eq=False)
class GraspTask:
    """What is to be done: which arm and gripper take which part, and where to.

    Attributes:
        robot: The bare arm.
        gripper: The gripper on its flange.
        grasp_object: The part.
        place: (n,) target configuration q_T (rad), reached at rest.
        settings: How the part is approached, pinched and lifted.
    """

    robot: RobotModel
    gripper: GripperModel
    grasp_object: GraspObject
    place: Array
    settings: TaskSettings = field(default_factory=TaskSettings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "place", read_only(self.place, (self.robot.n,)))

    @cached_property
    def kinematics(self) -> InverseKinematics:
        """Inverse kinematics of the arm."""
        return inverse_kinematics_for(self.robot)

    @cached_property
    def robot_empty(self) -> RobotModel:
        """The arm with the open gripper as a rigid payload."""
        return self.robot.with_payload(self.gripper.payload(self.gripper.open_posture))

    def robot_loaded(self, grasp: Grasp) -> RobotModel:
        """The arm with the closed gripper and the part in `grasp` as rigid payloads."""
        if grasp not in self._loaded:
            closed = self.closed_posture(grasp)
            T_flange_object = self.T_flange_closed(grasp) * grasp.T_object_grasp.inverse()
            part = T_flange_object.act(self.grasp_object.spatial_inertia)
            self._loaded[grasp] = self.robot.with_payload(self.gripper.payload(closed)).with_payload(part)
        return self._loaded[grasp]

    def pinch(self, grasp: Grasp) -> Pinch:
        """How the hand presses on the part in `grasp`."""
        friction, force = self.grasp_object.friction, self.settings.grip_share * self.gripper.pinch_force
        return Pinch(force, friction.sliding, friction.torsional, grasp.width)

    def closed_posture(self, grasp: Grasp) -> Array:
        """(m,) posture of the gripper around the part, a little narrower than the part so that it presses.

        Raises:
            GraspRefused: The gripper does not close or open that far.
        """
        if grasp.width not in self._closed:
            posture = self.gripper.posture_for(grasp.width - self.settings.over_close)
            self._closed[grasp.width] = read_only(posture)
        return self._closed[grasp.width]

    @cached_property
    def T_flange_open(self) -> pin.SE3:
        """The grasp frame in the flange frame with the gripper open."""
        return self.gripper.T_flange_hand * self.gripper.T_hand_grasp(self.gripper.open_posture)

    def T_flange_closed(self, grasp: Grasp) -> pin.SE3:
        """The grasp frame in the flange frame with the gripper closed around the part."""
        closed = self.closed_posture(grasp)
        if grasp.width not in self._T_flange_closed:
            self._T_flange_closed[grasp.width] = self.gripper.T_flange_hand * self.gripper.T_hand_grasp(closed)
        return self._T_flange_closed[grasp.width]

    # Planning asks for these again and again: they change with the grasp alone.
    @cached_property
    def _loaded(self) -> dict[Grasp, RobotModel]:
        return {}

    @cached_property
    def _closed(self) -> dict[float, Array]:
        return {}

    @cached_property
    def _T_flange_closed(self) -> dict[float, pin.SE3]:
        return {}
