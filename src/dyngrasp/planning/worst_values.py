"""The worst value of every constraint that holds along a plan, over many samples of it at once, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dyngrasp.models.batch_dynamics import compose, frame_poses, side_by_side
from dyngrasp.models.newton_euler import newton_euler, wrench_along
from dyngrasp.models.pinch import pad_loads
from dyngrasp.motion_arrays import largest
from dyngrasp.planning.audit_rows import ARM, AXIS, DIP, FUNNEL, GRIPPER, HOLD, TILT, TORQUE, enter
from dyngrasp.planning.part_motion import part_poses

# A smooth function departs from the chord between two grid points by about an eighth of its second difference there. An
# interval in which four times that could break a constraint is suspect.
CURVATURE_FACTOR = 4.0 / 8.0

_pad_loads = njit(cache=True)(pad_loads)


class Wall(NamedTuple):
    """What part of its height the wall of the funnel has: more and more of it where a motion begins outside.

    Attributes:
        factor: At the begin.
        low, high: Shares of the duration until which it stays there, and at which the wall is whole.
        begin: When the motion begins (s).
        duration: s.
    """

    factor: float
    low: float
    high: float
    begin: float
    duration: float


WHOLE = Wall(1.0, 0.0, 1.0, 0.0, 1.0)


@njit(cache=True, error_model="numpy")
def enter_worst_values(samples, part, wall, models, table):
    """Enter the worst values of all constraints along a plan into a table of `ROWS`.

    Args:
        samples: `PlanSamples`.
        part: Where the part is, of `part_motion`.
        wall: `Wall`.
        models: `PlanModels`.
        table: Of `empty_table`, or with what other samples entered.

    Returns:
        (M,) samples between which and the next one a constraint could be broken.
    """
    times, arm, gripper, (closing, lifted, last) = samples
    suspects = np.zeros(last, dtype=np.bool_)
    _enter_limits(arm, models.arm_boxes, times, table[ARM:], suspects)
    _enter_limits(gripper, models.gripper_boxes, times, table[GRIPPER:], suspects)
    if lifted:
        hand, ringing = models.hand, np.zeros(lifted)
        _add_ringing(arm[2], times[:lifted], ringing)
        _add_ringing(gripper[2], times[:lifted], ringing)
        both = side_by_side(arm[0, :, :lifted], gripper[0, :, :lifted], hand.arm_indices, hand.hand_indices)
        R, p = frame_poses(both, hand.tree, hand.frames)
        G, angle = hand_in_grasp_frame(R, p, times[:lifted], part, models.grasp_on_part)
        _enter_funnel(G[:, :closing], wall, models, ringing, times, table[FUNNEL], suspects)
        _enter_closing(G, angle, closing, models, ringing, times, table, suspects)
    carries = np.zeros(last)
    carries[lifted:] = 1.0
    torque, motion = newton_euler(arm[0], arm[1], arm[2], models.empty, models.carried, carries)
    share = _shares(torque, np.zeros(models.torque.size), models.torque)
    _enter_shares(share, times, table[TORQUE])
    _mark_bends(share, suspects)
    grip = _grip_shares(motion[:, lifted:], models.held)
    _judge(grip, np.zeros(grip.size), 1.0, 1.0, times[lifted:], table[HOLD], suspects[lifted:])
    # What follows the last sample of a phase is a join: no time passes there.
    for stop in (closing, lifted, last):
        if stop > 0:
            suspects[stop - 1] = False
    return suspects


@njit(cache=True, error_model="numpy")
def _enter_limits(states, boxes, times, rows, suspects):
    """Positions, velocities and accelerations (3, n, M) within boxes, as parts of their half-widths.

    Between two samples the acceleration is linear. So a velocity departs from its chord by Δt/8 times the change of the
    acceleration, a position by Δt²/8 times the larger one of the two, at most.
    """
    middles, limits = boxes
    for kind in range(3):
        share = _shares(states[kind], middles[kind], limits[kind])
        _enter_shares(share, times, rows[kind])
        if kind < 2:
            _mark_departures(share, states[2], limits[kind], kind, times, suspects)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _mark_departures(share, acceleration, limits, kind, times, suspects):
    """Mark the intervals in which positions (kind 0) or velocities (1) could pass limits, of which they are shares."""
    last = max(share.shape[1] - 1, 0)
    reached = np.zeros(max(last, 1))
    for i in range(limits.size):
        inverse = 1.0 / (8.0 * limits[i])
        for k in range(last):
            step, x, y = times[k + 1] - times[k], share[i, k], share[i, k + 1]
            v, v_next = acceleration[i, k], acceleration[i, k + 1]
            # (|a + b| + |a − b|) / 2 is the larger of |a| and |b|.
            departs = step * abs(v_next - v)
            if kind == 0:
                departs = step * step * (abs(v_next + v) + abs(v_next - v)) / 2.0
            reached[k] = (x + y + abs(x - y)) / 2.0 + inverse * departs
        if not largest(reached) <= 1.0:
            for k in range(last):
                if not reached[k] <= 1.0:
                    suspects[k] = True


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _add_ringing(acceleration, times, ringing):
    """Add how far (M,) (rad) joints may go from where a smooth motion would, between samples and the next ones.

    Accelerations (n, M) that jump to and fro leave no trace in the positions at the samples. What jumps, their second
    difference, moves a joint by Δt²/8 times that, at most.
    """
    bends = np.zeros(times.size)
    for i in range(acceleration.shape[0]):
        v = acceleration[i]
        for k in range(1, times.size - 1):
            bends[k] += abs(v[k - 1] - 2.0 * v[k] + v[k + 1])
    for k in range(1, times.size - 1):
        # Where a phase ends accelerations may jump.
        if times[k] == times[k - 1] or times[k + 1] == times[k]:
            bends[k] = 0.0
    for k in range(times.size - 1):
        step = times[k + 1] - times[k]
        ringing[k] += step * step / 8.0 * max(bends[k], bends[k + 1])


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
def _enter_shares(share, times, row):
    """Enter the largest of shares (n, M) ≥ 0."""
    if share.shape[1] > 0:
        for i in range(share.shape[0]):
            most = largest(share[i])
            if row[2] < 0.0 or not most <= row[0]:
                enter(row, 1.0, most, times[_first_at(share[i], most)], i)


@njit(cache=True, error_model="numpy")
def _mark_bends(share, suspects):
    """Mark the intervals in which shares (n, M) could exceed one."""
    nothing = np.zeros(share.shape[1])
    for i in range(share.shape[0]):
        # Between zero and the largest no second difference exceeds twice that: most are far from one everywhere.
        most = largest(share[i]) if nothing.size > 0 else 0.0
        if not 1.0 - most >= CURVATURE_FACTOR * 2.0 * most:
            _mark_suspects(share[i], nothing, 1.0, 1.0, suspects)


@njit(cache=True, error_model="numpy")
def _enter_funnel(G, wall, models, ringing, times, row, suspects):
    """Height h(q) of G (3, M), eq. (6), above the inverted Gaussian of eq. (5) times what there is of the wall."""
    (sigma_x, sigma_y, threshold), height = models.funnel, np.empty(G.shape[1])
    for s in range(height.size):
        share = ((times[s] - wall.begin) / wall.duration - wall.low) / (wall.high - wall.low)
        risen = wall.factor + (1.0 - wall.factor) * min(max(share, 0.0), 1.0)
        bell = np.exp(-0.5 * ((G[0, s] / sigma_x) ** 2 + (G[1, s] / sigma_y) ** 2))
        height[s] = G[2, s] - risen * threshold * (1.0 - bell)
    # The wall is steepest where the Gaussian turns: z_th / σ times e^(−1/2).
    steepest = threshold / min(sigma_x, sigma_y) * np.exp(-0.5)
    _judge(height, (1.0 + steepest) * models.reach * ringing, 0.0, -1.0, times, row, suspects)


@njit(cache=True, error_model="numpy")
def _enter_closing(G, angle, closing, models, ringing, times, table, suspects):
    """While the hand closes G stays on the grasp axis and not far below the frame, and the hand does not turn."""
    aside = np.empty(angle.size - closing)
    for s in range(aside.size):
        aside[s] = np.sqrt(G[0, closing + s] ** 2 + G[1, closing + s] ** 2)
    times, suspects, bounds, ringing = times[closing:], suspects[closing:], models.bounds, ringing[closing:]
    between = models.reach * ringing
    _judge(aside, between, bounds[AXIS], 1.0, times, table[AXIS], suspects)
    _judge(G[2, closing:], between, bounds[DIP], -1.0, times, table[DIP], suspects)
    _judge(angle[closing:], ringing, bounds[TILT], 1.0, times, table[TILT], suspects)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def hand_in_grasp_frame(R, p, times, part, grasp_on_part):
    """The hand as seen from the grasp frame where the part is.

    Args:
        R: (3, 3, 3, ≥ M) frames of the hand and both pads.
        p: (3, 3, ≥ M) m.
        times: (M,) s.
        part: Of `part_motion`.
        grasp_on_part: The grasp frame in the part's.

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
        for a in range(3):
            G[a, s] = R_grasp[0, a, s] * x + R_grasp[1, a, s] * y + R_grasp[2, a, s] * z
    write_angles(R[0], R_grasp, angle)
    return G, angle


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def write_angles(R, R_other, angle):
    """Write the angles (M,) (rad) between rotations (3, 3, M), exact near zero."""
    for s in range(angle.size):
        chord = 0.0
        for a in range(3):
            for b in range(3):
                chord += (R[a, b, s] - R_other[a, b, s]) ** 2
        angle[s] = 2.0 * np.arcsin(min(np.sqrt(chord / 8.0), 1.0))


@njit(cache=True, error_model="numpy")
def _grip_shares(motion, held):
    """Share of its friction (M,) that the busier pad needs to carry the part, velocity terms included.

    The safety factor of the planner is not applied here: at 1 the part would just slip. `motion` (9, M) is that of the
    link that carries the part.
    """
    (R, p), share = held.grasp, np.empty(motion.shape[1])
    wrench = wrench_along(motion.copy(), held.mass, held.first_moment, held.inertia)
    for s in range(share.size):
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
        (load, normal), (other_load, other_normal) = _pad_loads(force, moment, held.pinch)
        one, other = np.sqrt(load) / max(normal, 1e-9), np.sqrt(other_load) / max(other_normal, 1e-9)
        share[s] = one if not one <= other else other
    return share


@njit(cache=True, error_model="numpy")
def _judge(values, unseen, bound, sign, times, row, suspects):
    """Enter the worst of values (M,), and mark where a bound could be broken between two of them.

    For `sign` 1 they must not exceed the bound, for −1 not fall below it. By `unseen` (M,) they may change between two
    samples without a trace in them. Nothing is entered where there are none.
    """
    if values.size > 0:
        worst = 0
        for s in range(values.size):
            if not sign * values[s] <= sign * values[worst] and values[worst] == values[worst]:
                worst = s
        enter(row, sign, values[worst], times[worst], 0)
        _mark_suspects(values, unseen, bound, sign, suspects)


@njit(cache=True)
def _first_at(values, wanted):
    """Index of the first of the values (M,) that is the wanted one; NaN is NaN."""
    s = 0
    while values[s] != wanted and not (wanted != wanted and values[s] != values[s]):
        s += 1
    return s


@njit(cache=True, error_model="numpy")
def _mark_suspects(row, unseen, bound, sign, suspects):
    """Mark the intervals between samples of a row (M,) in which the bound is not farther than it may bend."""
    last, before = row.size - 1, 0.0
    for k in range(last):
        after = abs(row[k] - 2.0 * row[k + 1] + row[k + 2]) if k + 2 <= last else 0.0
        slack = min(sign * (bound - row[k]), sign * (bound - row[k + 1])) - unseen[k]
        # A NaN is suspect as well.
        if not slack >= CURVATURE_FACTOR * max(before, after):
            suspects[k] = True
        before = after
