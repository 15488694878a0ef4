"""The problems of the three phases for one pose of the part. What does not depend on the pose is made once."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.planning import constraints
from dyngrasp.planning.collocation.closed_form import best_duration, within_speed_limits
from dyngrasp.planning.collocation.gripper_path import GripperPath, gripper_path
from dyngrasp.planning.collocation.node_functions import node_functions
from dyngrasp.planning.collocation.settings import CollocationSettings
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import AuditReport, NodeConstraint, PhaseProblem
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory

Kept = TypeVar("Kept")
MOST_KEPT = 64  # motions of the hand and grasps that a planner remembers

# The pre-grasp itself stands 20 mm above the tip of the funnel (m).
LARGEST_FUNNEL_MARGIN = 0.015

PHASE_OF_RESERVE = {"funnel": 0, "hold": 2}
"""Which phase to solve again where the audit finds that the reserve of a row was too small."""


@dataclass(frozen=True)
class Reserves:
    """What rows keep in hand for what they leave out, and the velocities that they are told.

    Attributes:
        funnel: Margin of h for the chords between the grid points (m).
        hold: Factor on the pinch.
        carried: Motion whose velocities load the pinch; None for that of least effort.
    """

    funnel: float
    hold: float
    carried: Trajectory | None = None

    @classmethod
    def of(cls, settings: CollocationSettings) -> Reserves:
        """Those that planning begins with."""
        return cls(settings.funnel_margin * (100 / settings.intervals) ** 2, settings.hold_safety)

    def raised(self, report: AuditReport, carried: Trajectory) -> Reserves | None:
        """Larger by what the audit found missing; None if that is nothing, or more than reserves can help.

        Args:
            report: What the audit says of a plan.
            carried: Its delivery.
        """
        missing = {entry.name: entry.worst for entry in report.failures}
        if not missing or not missing.keys() <= PHASE_OF_RESERVE.keys() or self.funnel >= LARGEST_FUNNEL_MARGIN:
            return None
        # A little more than was missing: the new motion differs from the one that was looked at.
        raised = replace(self, funnel=self.funnel - 1.3 * missing.get("funnel", 0.0))
        return replace(raised, hold=1.02 * self.hold, carried=carried) if "hold" in missing else raised


@dataclass(frozen=True)
class HandMotion:
    """The hand's motion of one phase.

    Attributes:
        path: In normalised time.
        shortest: The least duration within its limits (s).
        grasp_points: (N+1, 3) G in the flange frame along it (m).
    """

    path: GripperPath
    shortest: float
    grasp_points: Array


@dataclass(frozen=True)
class _Carried:
    """What a delivery needs of one grasp and one target.

    Attributes:
        torque: Torque rows of the loaded arm.
        inertia: Of the part in the flange frame.
        corners: (K, 3) of the part's underside in the flange frame (m).
        end_heights: (K,) of these at the target (m).
    """

    torque: NodeConstraint
    inertia: pin.Inertia
    corners: Array
    end_heights: Array


class PhaseProblems:
    """States the problems of one task.

    Args:
        task: Arm, gripper, part and target.
        settings: How to plan.
    """

    def __init__(self, task: GraspTask, settings: CollocationSettings) -> None:
        self.task, self.settings = task, settings
        self._kept: dict[Hashable, object] = {}

    def hand(self, targets: GraspTargets, gripper_start: Array | None) -> tuple[HandMotion, HandMotion, HandMotion]:
        """The hand's motion in each phase, from its present posture (m,) or from the open one (rad)."""
        start = targets.gripper_open if gripper_start is None else np.asarray(gripper_start, dtype=float)
        opened, closed = targets.gripper_open, targets.gripper_closed
        return self._hand_motion(start, opened), self._hand_motion(opened, closed), self._hand_motion(closed, closed)

    def state(
        self,
        start: BoundaryState,
        targets: GraspTargets,
        hand: tuple[HandMotion, HandMotion, HandMotion],
        reserves: Reserves,
        start_time: float,
    ) -> tuple[PhaseProblem, PhaseProblem, PhaseProblem]:
        """The problems of approach, grasp and delivery.

        Args:
            start: Of the arm.
            targets: Boundary states of the phases.
            hand: From `hand` of the same targets.
            reserves: What rows keep in hand.
            start_time: Time of the first grid point on the common clock (s).

        Raises:
            InvalidProblem: The hand cannot close in time, or a moving part cannot be met when the targets say.
        """
        limits, settings = self.task.settings, self.settings
        shortest, longest = max(hand[1].shortest, limits.grasp_duration_min), limits.grasp_duration_max
        if hand[1].shortest > longest:
            raise InvalidProblem(
                f"grasp: {self.task.gripper.name} needs {hand[1].shortest:.3f} s to close, grasp_duration_max is "
                f"{longest:g} s"
            )
        spans = [(hand[0].shortest, settings.max_duration), (shortest, longest)]
        if targets.moving:
            # The part waits for nobody: it is where the targets say at their time alone.
            until_pregrasp = targets.grasp_time - targets.grasp_duration - start_time
            spans = [_only(until_pregrasp, *spans[0], "approach"), _only(targets.grasp_duration, *spans[1], "grasp")]
        funnel = self._funnel(start, targets, hand[0], reserves.funnel, start_time)
        tube = self._tube(targets, hand[1])
        approach = self._phase("approach", start, targets.pregrasp, (self._torque, funnel), *spans[0])
        grasp = self._phase("grasp", targets.pregrasp, targets.grasped, (self._torque, tube), *spans[1])
        return approach, grasp, self._delivery(targets, reserves)

    @cached_property
    def _torque(self) -> NodeConstraint:
        """Torque rows of the arm with the open gripper."""
        return constraints.torque_rows(self.task.robot_empty, self.settings.intervals, self.settings.torque_fraction)

    @cached_property
    def _limits(self) -> tuple[Array, Array, Array]:
        """Positions (rad) and speed (rad/s) that a plan keeps where no boundary state needs more."""
        settings, limits = self.settings, self.task.robot.limits
        margin = settings.position_margin
        inner = limits.position_lower + margin, limits.position_upper - margin
        return *inner, settings.velocity_fraction * limits.velocity

    def _phase(
        self,
        name: str,
        start: BoundaryState,
        end: BoundaryState,
        rows: tuple[NodeConstraint, ...],
        shortest: float,
        longest: float,
    ) -> PhaseProblem:
        settings, limits = self.settings, self.task.robot.limits
        inner_lower, inner_upper, speed = self._limits
        lowest, highest = np.minimum(start.position, end.position), np.maximum(start.position, end.position)
        # A moving start may be a little faster than the fraction: speed peaks between the grid points too.
        fastest = np.maximum(np.abs(start.velocity), np.abs(end.velocity))
        return PhaseProblem(
            name=name,
            start_position=start.position,
            start_velocity=start.velocity,
            end_position=end.position,
            end_velocity=end.velocity,
            position_lower=np.maximum(np.minimum(inner_lower, lowest), limits.position_lower),
            position_upper=np.minimum(np.maximum(inner_upper, highest), limits.position_upper),
            velocity_limit=np.minimum(np.maximum(speed, fastest), limits.velocity),
            acceleration_limit=limits.acceleration,
            constraints=rows,
            intervals=settings.intervals,
            effort_weight=settings.effort_weight,
            min_duration=shortest,
            max_duration=longest,
        )

    def _funnel(
        self, start: BoundaryState, targets: GraspTargets, hand: HandMotion, margin: float, start_time: float
    ) -> NodeConstraint:
        """The funnel with its margin, or with what the boundary states leave of it."""
        frames = self._grasp_frames(targets, start_time, targets.grasp_time - targets.grasp_duration)
        funnel = constraints.funnel(self.task.robot, hand.grasp_points, frames, self.task.grasp_object.funnel, margin)
        ends, at_ends = np.array([start.position, targets.pregrasp.position]), np.empty((2, 1))
        node_functions(funnel).values(ends, np.zeros_like(ends), funnel.parameters[[0, -1]], at_ends, 0)
        # A little less than the ends have, so that an interior point remains.
        left = 0.9 * float(at_ends.min())
        return replace(funnel, lower=np.array([max(left, 0.0)])) if left < margin else funnel

    def _tube(self, targets: GraspTargets, hand: HandMotion) -> NodeConstraint:
        settings = self.task.settings
        return constraints.grasp_tube(
            self.task.robot,
            hand.grasp_points,
            self.task.T_flange_closed(targets.grasp).rotation,
            self._grasp_frames(targets, targets.grasp_time - targets.grasp_duration, targets.grasp_time),
            settings.lateral_tolerance,
            settings.dip_tolerance,
            settings.tilt_tolerance,
        )

    def _delivery(self, targets: GraspTargets, reserves: Reserves) -> PhaseProblem:
        task, part = self.task, self._carried(targets)
        deliver = self._phase(
            "deliver", targets.grasped, targets.place, (part.torque,), 0.0, self.settings.max_duration
        )
        motion = reserves.carried or within_speed_limits(deliver, best_duration(deliver))
        closed, pinch = task.T_flange_closed(targets.grasp), task.pinch(targets.grasp)
        hold = constraints.hold(task.robot, part.inertia, closed, pinch, motion.velocity, reserves.hold)
        pose = targets.T_world_object
        start_heights = pose.translation[2] + task.grasp_object.underside @ pose.rotation[2]
        floor = constraints.lift_floor(start_heights, part.end_heights, self.settings.intervals)
        above_ground = constraints.above_ground(task.robot, part.corners, floor)
        return replace(deliver, constraints=(part.torque, hold, above_ground))

    def _grasp_frames(self, targets: GraspTargets, start: float, end: float) -> pin.SE3 | list[pin.SE3]:
        """The grasp frame at the grid points between two times (s); the only one of a part at rest."""
        if not targets.moving:
            return targets.T_world_grasp
        times = np.linspace(start, end, self.settings.intervals + 1)
        return [targets.T_world_object_at(t) * targets.grasp.T_object_grasp for t in times]

    def _hand_motion(self, start: Array, end: Array) -> HandMotion:
        def make() -> HandMotion:
            gripper = self.task.gripper
            path = gripper_path(start, end, self.settings.intervals)
            T = gripper.T_flange_hand
            points = gripper.grasp_point_many(path.position) @ T.rotation.T + T.translation
            return HandMotion(path, path.shortest_duration(gripper.velocity, gripper.acceleration), points)

        return self._once((start.tobytes(), end.tobytes()), make)

    def _carried(self, targets: GraspTargets) -> _Carried:
        def make() -> _Carried:
            task, settings = self.task, self.settings
            # The part in the flange frame as the closed hand holds it.
            T = task.T_flange_closed(targets.grasp) * targets.grasp.T_object_grasp.inverse()
            underside = task.grasp_object.underside
            place = task.robot.forward_kinematics(targets.place.position) * T
            return _Carried(
                constraints.torque_rows(task.robot_loaded(targets.grasp), settings.intervals, settings.torque_fraction),
                T.act(task.grasp_object.spatial_inertia),
                underside @ T.rotation.T + T.translation,
                place.translation[2] + underside @ place.rotation[2],
            )

        return self._once((targets.grasp, targets.place.position.tobytes()), make)

    def _once(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """What was made for this key before, else what is made now; what was made longest ago makes room."""
        if key not in self._kept:
            self._kept[key] = make()
            if len(self._kept) > MOST_KEPT:
                del self._kept[next(iter(self._kept))]
        return self._kept[key]  # type: ignore[return-value]


def _only(duration: float, shortest: float, longest: float, phase: str) -> tuple[float, float]:
    """Bounds that leave one duration (s), which must be within the others."""
    if not shortest - 1e-9 <= duration <= longest + 1e-9:
        raise InvalidProblem(
            f"{phase}: the part is met after {duration:.3f} s, possible are {shortest:.3f} to {longest:g} s"
        )
    return duration, duration
