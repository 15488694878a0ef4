"""The worst value of every constraint that holds along a plan, over many samples of it at once, compiled."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.assembly import assemble
from dyngrasp.models.batch_dynamics import (
    Attachments,
    BatchModel,
    compose,
    frame_poses,
    joint_torques,
    link_wrenches,
    newton,
    side_by_side,
)
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.models.pinch import Pinch, pad_loads
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import PartMotion, part_poses
from dyngrasp.planning.plan_samples import PlanSamples
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import largest

# A function of the motion departs from the chord between two grid points by about an eighth of its second difference
# there. An interval in which four times that could break a constraint is suspect.
CURVATURE_FACTOR = 4.0 / 8.0

# Rows of the table of worst values: name, whether the bound is a lower one, and whose joints it is about.
ROWS = (
    ("position", False, "arm_joints"),
    ("velocity", False, "arm_joints"),
    ("acceleration", False, "arm_joints"),
    ("gripper_position", False, "gripper_joints"),
    ("gripper_velocity", False, "gripper_joints"),
    ("gripper_acceleration", False, "gripper_joints"),
    ("torque", False, "arm_joints"),
    ("funnel", True, ""),
    ("grasp_axis", False, ""),
    ("grasp_dip", True, ""),
    ("grasp_tilt", False, ""),
    ("hold", False, ""),
)
GRIPPER, TORQUE, FUNNEL, AXIS, DIP, TILT, HOLD = 3, 6, 7, 8, 9, 10, 11

_pad_loads = njit(cache=True)(pad_loads)


class PlanModels:
    """What does not change from plan to plan: arrays of the arm empty and loaded, frames of the hand, limits.

    Args:
        task: Arm, gripper, part and settings.
        grasp_name: How the part is taken.

    Attributes:
        bounds: (12,) of `ROWS`.
        hand: Where the joints of arm and hand are in their tree; the tree; a frame of the hand, turned like the grasp,
            and those of both pads.
        grasp_on_part: Rotation (3, 3) and position (3,) of the grasp frame in the part's.
    """

    def __init__(self, task: GraspTask, grasp_name: str) -> None:
        grasp = next(grasp for grasp in task.grasp_object.grasps if grasp.name == grasp_name)
        robot, part, settings, gripper = task.robot, task.grasp_object, task.settings, task.gripper
        loaded = BatchModel.from_pinocchio(task.robot_loaded(grasp).loaded_model)
        self._empty = BatchModel.from_pinocchio(task.robot_empty.loaded_model).chain
        # What the hand carries changes the inertia of the last link and nothing else.
        self._loaded = float(loaded.mass[-1]), loaded.first_moment[-1], loaded.inertia[-1]
        assembly = assemble(robot, gripper)
        tree = BatchModel.from_pinocchio(assembly.pin_model)
        frames = self._frames(tree, assembly.pin_model, assembly.flange_id, task)
        self.hand = assembly.arm_indices, assembly.hand_indices, tree.tree, frames.arrays
        self.grasp_on_part = read_only(grasp.T_object_grasp.rotation), read_only(grasp.T_object_grasp.translation)
        held = loaded.attach([(robot.n, robot.T_last_flange * task.T_flange_closed(grasp))])
        T_link_held = pin.SE3(held.rotations[0], held.positions[0])
        body = (T_link_held * grasp.T_object_grasp.inverse()).act(part.spatial_inertia)
        self._held = (
            float(body.mass), read_only(body.mass * body.lever), read_only(body.matrix()[3:, 3:]),
            held.rotations[0], held.positions[0], Pinch(*(float(x) for x in task.pinch(grasp))),
        )  # fmt: skip
        limits = robot.limits
        self._limits = (
            _boxes(limits.position_lower, limits.position_upper, limits.velocity, limits.acceleration),
            _boxes(gripper.lower, gripper.upper, gripper.velocity, gripper.acceleration),
            read_only(limits.torque),
        )
        funnel = part.funnel
        self._funnel = float(funnel.sigma_x), float(funnel.sigma_y), float(funnel.z_threshold)
        tolerances = settings.lateral_tolerance, -settings.dip_tolerance, settings.tilt_tolerance
        self.bounds = read_only([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, *tolerances, 1.0])

    def _frames(self, tree: BatchModel, model: pin.Model, flange_id: int, task: GraspTask) -> Attachments:
        pads = (frames_named(model, name)[0] for name in task.gripper.pads)
        frames = [model.frames[i] for i in (flange_id, *pads)]
        (flange, T), *fingers = [(int(frame.parentJoint), pin.SE3(frame.placement)) for frame in frames]
        # The axes of the pinch are those of the hand; only its origin depends on the fingers.
        return tree.attach([(flange, T * task.T_flange_open), *fingers])

    def worst_values(self, samples: PlanSamples, part: PartMotion, wall: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Evaluate all constraints.

        Args:
            samples: Of the plan.
            part: Where the part is.
            wall: What part of its height the wall of the funnel has at the samples of the approach.

        Returns:
            (12, 3), one of `ROWS` each: the worst value, its time (s) and joint, or −1 where there are no samples; (M,)
            samples between which and the next one a constraint could be broken.
        """
        return _worst_values(
            samples.times, samples.arm, samples.gripper, samples.stops, wall, part, self.grasp_on_part,
            self._limits, self._empty, self._loaded, self.hand,
            self._held, self._funnel, self.bounds,
        )  # fmt: skip


@lru_cache(maxsize=8)
def plan_models(task: GraspTask, grasp_name: str) -> PlanModels:
    """The models of a task, made once."""
    return PlanModels(task, grasp_name)


def _boxes(lower: Array, upper: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array]:
    """Middles and half-widths (3, n) of the ranges of position, velocity and acceleration."""
    zero = np.zeros_like(velocity)
    return read_only([(upper + lower) / 2, zero, zero]), read_only([(upper - lower) / 2, velocity, acceleration])


@njit(cache=True, error_model="numpy")
def _worst_values(
    times, arm, gripper, stops, wall, part, grasp_on_part, limits, empty, loaded, hand, held, funnel, bounds
):
    """See `PlanModels.worst_values`; `loaded` is the last link from the lift on."""
    closing, lifted, last = stops
    table, suspects = np.full((len(ROWS), 3), -1.0), np.zeros(last, dtype=np.bool_)
    _limits(arm, limits[0], times, table[:GRIPPER], suspects)
    _limits(gripper, limits[1], times, table[GRIPPER:TORQUE], suspects)
    if lifted:
        arm_indices, hand_indices, tree, frames = hand
        both = side_by_side(arm[0, :, :lifted], gripper[0, :, :lifted], arm_indices, hand_indices)
        R, p = frame_poses(both, tree, frames)
        _grasp_frame(R, p, part, grasp_on_part, times, wall, funnel, bounds, closing, table, suspects)
    wrenches, motion = link_wrenches(arm[0], arm[1], arm[2], empty)
    if last > lifted:
        mass, first_moment, inertia = loaded
        carrying, wrench = motion[:, lifted:].copy(), np.empty((6, last - lifted))
        newton(mass, first_moment, inertia, carrying, wrench)
        wrenches[-1, :, lifted:] = wrench
        _hold(carrying, held, times, lifted, table[HOLD], suspects)
    torque = joint_torques(arm[0], arm[2], wrenches, empty)
    share = _shares(torque, np.zeros(limits[2].size), limits[2])
    _judge(share, 0, 1.0, 1.0, times, table[TORQUE], suspects)
    # What follows the last sample of a phase is a join: no time passes there.
    for stop in stops:
        if stop > 0:
            suspects[stop - 1] = False
    return table, suspects


@njit(cache=True, error_model="numpy")
def _limits(states, boxes, times, table, suspects):
    """Positions, velocities and accelerations (3, n, M) within `_boxes`, as parts of their half-widths."""
    middles, limits = boxes
    for kind in range(3):
        share = _shares(states[kind], middles[kind], limits[kind])
        if kind < 2:
            _judge(share, 0, 1.0, 1.0, times, table[kind], suspects)
        else:
            # Between two grid points accelerations are linear: no worse than there.
            _enter(share, 0, 1.0, times, table[kind])


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _shares(values, middles, limits):
    """Values (n, M) less their middles (n,) as parts of their limits (n,)."""
    share = np.empty(values.shape)
    for i in range(limits.size):
        middle, inverse = middles[i], 1.0 / limits[i]
        for k in range(values.shape[1]):
            share[i, k] = abs(values[i, k] - middle) * inverse
    return share


@njit(cache=True, error_model="numpy")
def _grasp_frame(R, p, part, grasp_on_part, times, wall, funnel, bounds, closing, table, suspects):
    """What the hand (3, 3, 3, M), (3, 3, M) does above and at the grasp frame, in approach and grasp.

    In the approach h(q) of eq. (6), how high G is above the inverted Gaussian of eq. (5) times `wall`. In the grasp G
    stays on the grasp axis, does not pass far below the grasp frame, and the hand does not turn as it closes.
    """
    samples, (sigma_x, sigma_y, threshold) = p.shape[2], funnel
    G, angle = hand_in_grasp_frame(R, p, part, grasp_on_part, times[:samples])
    height, above = np.empty((1, closing)), np.empty((1, samples - closing))
    aside, tilt = np.empty(above.shape), np.empty(above.shape)
    for s in range(closing):
        bell = np.exp(-0.5 * ((G[0, s] / sigma_x) ** 2 + (G[1, s] / sigma_y) ** 2))
        height[0, s] = G[2, s] - wall[s] * threshold * (1.0 - bell)
    for s in range(closing, samples):
        aside[0, s - closing] = np.sqrt(G[0, s] ** 2 + G[1, s] ** 2)
        above[0, s - closing], tilt[0, s - closing] = G[2, s], angle[s]
    if closing > 0:
        _judge(height, 0, bounds[FUNNEL], -1.0, times, table[FUNNEL], suspects)
    if samples > closing:
        _judge(aside, closing, bounds[AXIS], 1.0, times, table[AXIS], suspects)
        _judge(above, closing, bounds[DIP], -1.0, times, table[DIP], suspects)
        _judge(tilt, closing, bounds[TILT], 1.0, times, table[TILT], suspects)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def hand_in_grasp_frame(R, p, part, grasp_on_part, times):
    """The hand as seen from the grasp frame where the part is at times (M,).

    Args:
        R: (3, 3, 3, ≥ M) frames of the hand and both pads.
        p: (3, 3, ≥ M) m.
        part: Of `part_motion`.
        grasp_on_part: Rotation (3, 3) and position (3,) (m) of the grasp frame in the part's.
        times: (M,) s.

    Returns:
        G (3, M), and the angle of the hand against the frame (M,); from the difference of both rotations, which is
        exact near zero.
    """
    samples = times.size
    R_part, p_part = np.empty((3, 3, samples)), np.empty((3, samples))
    R_grasp, p_grasp = np.empty((3, 3, samples)), np.empty((3, samples))
    part_poses(part, times, R_part, p_part)
    compose(R_part, p_part, grasp_on_part[0], grasp_on_part[1], R_grasp, p_grasp)
    G, angle = np.empty((3, samples)), np.empty(samples)
    for s in range(samples):
        x = (p[1, 0, s] + p[2, 0, s]) / 2 - p_grasp[0, s]
        y = (p[1, 1, s] + p[2, 1, s]) / 2 - p_grasp[1, s]
        z = (p[1, 2, s] + p[2, 2, s]) / 2 - p_grasp[2, s]
        chord = 0.0
        for a in range(3):
            G[a, s] = R_grasp[0, a, s] * x + R_grasp[1, a, s] * y + R_grasp[2, a, s] * z
            for b in range(3):
                chord += (R[0, a, b, s] - R_grasp[a, b, s]) ** 2
        angle[s] = 2.0 * np.arcsin(min(np.sqrt(chord / 8.0), 1.0))
    return G, angle


@njit(cache=True, error_model="numpy")
def _hold(motion, held, times, first, row, suspects):
    """Share of its friction that the busier pad needs to carry the part, velocity terms included.

    The safety factor of the planner is not applied here: at 1 the part would just slip. The part is given in the frame
    of the last link, like its `motion` (9, M), and so is the grasp frame.
    """
    (mass, first_moment, inertia, R, p, pinch), samples = held, motion.shape[1]
    wrench, share = np.empty((6, samples)), np.empty((1, samples))
    newton(mass, first_moment, inertia, motion, wrench)
    for s in range(samples):
        fx, fy, fz = wrench[0, s], wrench[1, s], wrench[2, s]
        # The moment about the grasp point.
        mx = wrench[3, s] - (p[1] * fz - p[2] * fy)
        my = wrench[4, s] - (p[2] * fx - p[0] * fz)
        mz = wrench[5, s] - (p[0] * fy - p[1] * fx)
        force = (
            R[0, 0] * fx + R[1, 0] * fy + R[2, 0] * fz,
            R[0, 1] * fx + R[1, 1] * fy + R[2, 1] * fz,
            R[0, 2] * fx + R[1, 2] * fy + R[2, 2] * fz,
        )
        moment = (
            R[0, 0] * mx + R[1, 0] * my + R[2, 0] * mz,
            R[0, 1] * mx + R[1, 1] * my + R[2, 1] * mz,
            R[0, 2] * mx + R[1, 2] * my + R[2, 2] * mz,
        )
        (load, normal), (other_load, other_normal) = _pad_loads(force, moment, pinch)
        one, other = np.sqrt(load) / max(normal, 1e-9), np.sqrt(other_load) / max(other_normal, 1e-9)
        share[0, s] = one if not one <= other else other
    _judge(share, first, 1.0, 1.0, times, row, suspects)


@njit(cache=True, error_model="numpy")
def _judge(values, first, bound, sign, times, row, suspects):
    """Enter the worst of values (k, m), at the samples from `first` on, and where a bound could be broken in between.

    For `sign` 1 they must not exceed the bound, for −1 not fall below it.
    """
    highest = _enter(values, first, sign, times, row)
    for j in range(values.shape[0]):
        # Most rows are far from their bounds everywhere: a NaN is not, nor is a bound that is one.
        slack = sign * bound - highest[j]
        if slack != slack or not slack >= CURVATURE_FACTOR * _largest_bend(values[j]):
            _mark_suspects(values[j], bound, sign, suspects[first : first + values.shape[1]])


@njit(cache=True, error_model="numpy")
def _enter(values, first, sign, times, row):
    """The worst of values (k, m), its time and which of the k it is; the first NaN, if there is one.

    Returns:
        (k,) largest of each times `sign`; NaN if there is one.
    """
    worst, which, highest, signed = -np.inf, 0, np.empty(values.shape[0]), np.empty(values.shape[1])
    for j in range(values.shape[0]):
        for k in range(signed.size):
            signed[k] = sign * values[j, k]
        total = _total(signed)
        highest[j] = largest(signed) if total == total else np.nan
        if not highest[j] <= worst and worst == worst:
            worst, which = highest[j], j
    at = 0
    for k in range(values.shape[1] - 1, -1, -1):
        if sign * values[which, k] == worst or (worst != worst and values[which, k] != values[which, k]):
            at = k
    row[0], row[1], row[2] = values[which, at], times[first + at], which
    return highest


@njit(cache=True, fastmath={"reassoc"})
def _total(row):
    """Sum of absolute values, in any order; NaN if one of them is."""
    total = 0.0
    for k in range(row.size):
        total += abs(row[k])
    return total


@njit(cache=True, error_model="numpy")
def _largest_bend(row):
    """Largest second difference of a row; NaN if there is one."""
    bends = np.zeros(max(row.size - 2, 1))
    for k in range(row.size - 2):
        bends[k] = abs(row[k] - 2.0 * row[k + 1] + row[k + 2])
    return largest(bends)


@njit(cache=True, error_model="numpy")
def _mark_suspects(row, bound, sign, suspects):
    """Mark the intervals between samples of a row (m,) in which the bound is not farther than it may bend."""
    last = row.size - 1
    for k in range(last):
        bend = abs(row[k - 1] - 2.0 * row[k] + row[k + 1]) if k > 0 else 0.0
        if k + 2 <= last:
            bend = max(bend, abs(row[k] - 2.0 * row[k + 1] + row[k + 2]))
        slack = min(sign * (bound - row[k]), sign * (bound - row[k + 1]))
        # A NaN is suspect as well.
        if not slack >= CURVATURE_FACTOR * bend:
            suspects[k] = True
