"""Was the part delivered, and if not, why: the criteria of success, each with its value and its own verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.simulation.plant import ContactCategory
from dyngrasp.trajectory import GraspPlan


@dataclass(frozen=True)
class SuccessLimits:
    """Where a criterion turns from passed to failed.

    Attributes:
        disturbance_mm: Largest motion of the part before both pads are on it.
        lift_delay: When after the grasp the part must be off the ground (s).
        settle_delay: From when after the grasp on slip counts (s): until then the fingers' squeeze rises.
        slip_mm, slip_deg: Largest motion of the part relative to the hand.
        place_mm, place_deg: Largest distance from where the plan puts the part.
        speed_ratio: Least max-norm of q̇/q̇max while the plan moves.
        speed_window: Part of the motion that the speed is watched in: it begins and ends at rest.
    """

    disturbance_mm: float = 3.0
    lift_delay: float = 0.1
    settle_delay: float = 0.2
    slip_mm: float = 5.0
    slip_deg: float = 5.0
    place_mm: float = 10.0
    place_deg: float = 5.0
    speed_ratio: float = 0.01
    speed_window: tuple[float, float] = (0.02, 0.98)


@dataclass(frozen=True)
class Criterion:
    """One criterion.

    Attributes:
        name: Which one.
        passed: The verdict.
        values: The measured numbers.
        t: When it failed, or would have (s).
        reason: In words.
    """

    name: str
    passed: bool
    values: dict[str, float | bool]
    t: float
    reason: str


@dataclass(frozen=True)
class Outcome:
    """Verdict on an episode.

    Attributes:
        criteria: In the order of the table of criteria.
        worst: Largest ratio to the limit of each kind, in the plant: "position", "velocity", "torque_plant".
        details: Numbers that explain but decide nothing.
    """

    criteria: tuple[Criterion, ...]
    worst: dict[str, float]
    details: dict[str, float]

    @property
    def success(self) -> bool:
        """Whether every criterion passed."""
        return all(criterion.passed for criterion in self.criteria)

    @property
    def cause(self) -> str:
        """The criterion that failed first in time, with its reason; "" after a success.

        A part that slips out also falls on something and lies in the wrong place; what came first is what to mend.
        """
        failed = [criterion for criterion in self.criteria if not criterion.passed]
        if not failed:
            return ""
        first = min(failed, key=lambda criterion: criterion.t)
        return f"{first.name}: {first.reason}"

    def summary(self) -> dict[str, Any]:
        """Values of all criteria and, under "passed", the verdict on each."""
        values: dict[str, Any] = {}
        for criterion in self.criteria:
            values.update(criterion.values)
        return {**values, "passed": {criterion.name: criterion.passed for criterion in self.criteria}}


def judge(
    plan: GraspPlan,
    record: EpisodeRecord,
    task: GraspTask,
    grasp: Grasp,
    began: float | None = None,
    limits: SuccessLimits | None = None,
) -> Outcome:
    """Judge an episode.

    Args:
        plan: What was carried out.
        record: What happened.
        task: Arm, gripper, part.
        grasp: The grasp that the plan takes.
        began: When the motion began (s); the record's first time if left out.
        limits: Where criteria turn.
    """
    limits = limits or SuccessLimits()
    began = float(record.t[0]) if began is None else began
    worst = _worst_ratios(record, task)
    slip, details = _slip(plan, record, grasp, limits)
    criteria = (
        _clear(record),
        _undisturbed(plan, record, task, grasp, limits),
        _lifted(plan, record, limits),
        _held(plan, record, limits),
        slip,
        _placed(plan, record, task, grasp, limits),
        _within_limits(worst, float(record.t[-1])),
        _moving(plan, record, task, limits, began),
    )
    return Outcome(criteria, worst, {**details, **_tracking(plan, record, began)})


def _clear(record: EpisodeRecord) -> Criterion:
    hit = {
        "the part, with something else than a pad": record.touched(ContactCategory.OTHER_ROBOT_PART),
        "the ground": record.touched(ContactCategory.ROBOT_GROUND),
        "itself": record.touched(ContactCategory.ROBOT_ROBOT),
    }
    # A touch that lasts is one collision, however many samples it fills.
    collisions = sum(int(np.count_nonzero(np.diff(np.r_[False, touched].astype(int)) == 1)) for touched in hit.values())
    first = {what: float(record.t[touched.argmax()]) for what, touched in hit.items() if touched.any()}
    reason = "; ".join(f"the robot hit {what} at {t:.2f} s" for what, t in first.items())
    return Criterion("clear", collisions == 0, {"collisions": collisions}, min(first.values(), default=np.inf), reason)


def _undisturbed(
    plan: GraspPlan, record: EpisodeRecord, task: GraspTask, grasp: Grasp, limits: SuccessLimits
) -> Criterion:
    closed = _both_pads(record) & (record.t <= plan.phase_ends[1])
    end = int(closed.argmax()) if closed.any() else record.index_at(plan.phase_ends[1])
    # Two points far apart: a push turns the part as well as it moves it, and one point may be where it turns about.
    points = np.array([grasp.T_object_grasp.translation, task.grasp_object.spatial_inertia.lever])
    before = np.array([record.T_world_part(0).act(p) for p in points])
    # A conveyor carries the part along: only what it moves relative to that is the hand's doing.
    carried = record.support_position - record.support_position[0]
    now = np.array([[record.T_world_part(k).act(p) for p in points] for k in range(end + 1)])
    distance = 1e3 * np.linalg.norm(now - before - carried[: end + 1, None], axis=2).max(axis=1)
    moved, too_far = float(distance.max()), distance >= limits.disturbance_mm
    return Criterion(
        "undisturbed",
        moved < limits.disturbance_mm,
        {"undisturbed_mm": moved},
        _first(record.t, too_far),
        f"the part was pushed {moved:.1f} mm before both pads were on it, limit {limits.disturbance_mm:g} mm",
    )


def _lifted(plan: GraspPlan, record: EpisodeRecord, limits: SuccessLimits) -> Criterion:
    at = record.index_at(plan.phase_ends[1] + limits.lift_delay)
    lifted = not bool(record.touched(ContactCategory.PART_GROUND)[at])
    return Criterion(
        "lifted",
        lifted,
        {"lifted": lifted},
        float(record.t[at]),
        f"the part still touched the ground {limits.lift_delay:g} s after the grasp",
    )


def _held(plan: GraspPlan, record: EpisodeRecord, limits: SuccessLimits) -> Criterion:
    after = record.index_at(plan.phase_ends[1] + limits.lift_delay)
    dropped = record.touched(ContactCategory.PART_GROUND)[after:] | ~_both_pads(record)[after:]
    held = not bool(dropped.any())
    t = _first(record.t[after:], dropped)
    return Criterion(
        "held", held, {"held": held}, t, f"the part was not between the pads, off the ground, at {t:.2f} s"
    )


def _slip(
    plan: GraspPlan, record: EpisodeRecord, grasp: Grasp, limits: SuccessLimits
) -> tuple[Criterion, dict[str, float]]:
    first = record.index_at(plan.phase_ends[1] + limits.settle_delay)
    p_object = grasp.T_object_grasp.translation
    in_hand = [record.T_world_hand(k).actInv(record.T_world_part(k)) for k in range(first, len(record))]
    G_in_hand = np.array([record.T_world_hand(k).actInv(record.grasp_point[k]) for k in range(first, len(record))])
    at_grasp = np.array([T.act(p_object) for T in in_hand])
    distance = np.linalg.norm(at_grasp - at_grasp[0], axis=1) * 1e3
    from_G = at_grasp - G_in_hand
    moved_from_G = float(np.linalg.norm(from_G - from_G[0], axis=1).max()) * 1e3
    angle = np.array([_angle_deg(in_hand[0], T) for T in in_hand])
    moved, turned = float(distance.max()), float(angle.max())
    slipped = (distance >= limits.slip_mm) | (angle >= limits.slip_deg)
    reason = (
        f"{moved:.1f} mm and {turned:.1f}° relative to the hand, limits {limits.slip_mm:g} mm and {limits.slip_deg:g}°"
    )
    t = _first(record.t[first:], slipped)
    criterion = Criterion("slip", not slipped.any(), {"slip_mm": moved, "slip_deg": turned}, t, reason)
    return criterion, {"slip_from_grasp_point_mm": moved_from_G}


def _placed(plan: GraspPlan, record: EpisodeRecord, task: GraspTask, grasp: Grasp, limits: SuccessLimits) -> Criterion:
    T_hand_grasp = task.gripper.T_hand_grasp(plan.gripper[-1].position[-1])
    T_world_hand = task.robot.forward_kinematics(plan.arm[-1].position[-1]) * task.gripper.T_flange_hand
    planned = T_world_hand * T_hand_grasp * grasp.T_object_grasp.inverse()
    actual = record.T_world_part(-1)
    off = float(np.linalg.norm(actual.translation - planned.translation)) * 1e3
    turned = _angle_deg(planned, actual)
    return Criterion(
        "placed",
        off < limits.place_mm and turned < limits.place_deg,
        {"place_mm": off, "place_deg": turned},
        float(record.t[-1]),
        f"{off:.1f} mm and {turned:.1f}° from where the plan puts it, limits {limits.place_mm:g} mm and "
        f"{limits.place_deg:g}°",
    )


def _worst_ratios(record: EpisodeRecord, task: GraspTask) -> dict[str, float]:
    joint = task.robot.limits
    middle, half = (joint.position_upper + joint.position_lower) / 2, (joint.position_upper - joint.position_lower) / 2
    return {
        "position": float((np.abs(record.arm_measured - middle) / half).max()),
        "velocity": float((np.abs(record.arm_velocity) / joint.velocity).max()),
        # What was applied can never pass the limit; only what was asked for tells whether the motors sufficed.
        "torque_plant": float((np.abs(record.arm_torque_commanded) / joint.torque).max()),
    }


def _within_limits(worst: dict[str, float], t: float) -> Criterion:
    # The controller clips at the torque limit, so a ratio of 1 means saturation: the plan was not followable.
    passed = worst["position"] <= 1 and worst["velocity"] <= 1 and worst["torque_plant"] < 1
    name = max(worst, key=lambda kind: worst[kind])
    return Criterion(
        "limits", passed, {"limits_ratio": worst[name]}, t, f"{name} reached {worst[name]:.3f} of its limit"
    )


def _moving(plan: GraspPlan, record: EpisodeRecord, task: GraspTask, limits: SuccessLimits, began: float) -> Criterion:
    # A plan that took over during the motion begins later than the motion.
    span = plan.end_time - began
    low, high = (began + share * span for share in limits.speed_window)
    window = (record.t >= low) & (record.t <= high)
    ratio = (np.abs(record.arm_velocity[window]) / task.robot.limits.velocity).max(axis=1)
    slowest = float(ratio.min())
    t = float(record.t[window][int(ratio.argmin())])
    return Criterion(
        "moving",
        slowest >= limits.speed_ratio,
        {"min_speed_ratio": slowest},
        t,
        f"the arm all but stopped at {t:.2f} s: speed ratio {slowest:.4f}, least {limits.speed_ratio:g}",
    )


def _tracking(plan: GraspPlan, record: EpisodeRecord, began: float) -> dict[str, float]:
    first = record.index_at(began)
    error = np.abs(record.arm_planned - record.arm_measured)[first:]
    at_grasp = record.index_at(plan.phase_ends[1]) - first
    return {
        "tracking_rms_rad": float(np.sqrt((error**2).mean())),
        "tracking_max_rad": float(error.max()),
        "tracking_at_grasp_rad": float(error[at_grasp].max()),
        "clamp_delay_s": _clamp_delay(plan, record),
    }


def _clamp_delay(plan: GraspPlan, record: EpisodeRecord) -> float:
    """When both pads first hold the part, relative to the planned grasp (s); NaN if they never do."""
    both = _both_pads(record)
    return float(record.t[both.argmax()] - plan.phase_ends[1]) if both.any() else float("nan")


def _first(t: NDArray[np.float64], failed: NDArray[np.bool_]) -> float:
    return float(t[failed.argmax()]) if failed.any() else float("inf")


def _both_pads(record: EpisodeRecord) -> NDArray[np.bool_]:
    return np.all(record.pad_force > 0, axis=1)


def _angle_deg(a: pin.SE3, b: pin.SE3) -> float:
    return float(np.rad2deg(np.linalg.norm(pin.log3(a.rotation.T @ b.rotation))))
