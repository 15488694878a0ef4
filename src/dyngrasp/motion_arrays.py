"""Motions as compiled code sees them: arrays on a uniform grid, looked at, checked and interpolated."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.signals import Array

# A join is two roundings of the same number, so it may differ by a few ulp of 2π and no more.
JOIN_TOLERANCE = 1e-9

PhaseArrays = tuple[float, Array, Array, Array]  # ΔT (s) and q, q̇, q̈, each (N+1, n)
Phases = tuple[PhaseArrays, ...]


@njit(cache=True)
def largest_difference(a, b):
    """Largest |a − b| of two vectors (n,); NaN if one of their elements is."""
    largest = 0.0
    for i in range(a.size):
        step = abs(a[i] - b[i])
        # A NaN, once found, stays.
        if not step <= largest and largest == largest:
            largest = step
    return largest


@njit(cache=True)
def largest_jump(phases):
    """Largest jump of positions and velocities over both joins of three phases."""
    largest = 0.0
    for i in range(2):
        (_, q, w, _), (_, q_next, w_next, _) = phases[i], phases[i + 1]
        largest = max(largest, largest_difference(q[-1], q_next[0]), largest_difference(w[-1], w_next[0]))
    return largest


@njit(cache=True)
def make_a_plan(arm, gripper, n, m):
    """Whether three phases of arm (n joints) and gripper (m joints) are what `Trajectory` and `GraspPlan` ask for."""
    for i in range(3):
        for (duration, q, w, v), joints in ((arm[i], n), (gripper[i], m)):
            if not (q.shape == w.shape == v.shape and q.shape[0] >= 2 and q.shape[1] == joints):
                return False
            if not (0.0 < duration < np.inf and all_finite(q, w, v)):
                return False
        if abs(arm[i][0] - gripper[i][0]) > JOIN_TOLERANCE:
            return False
    return largest_jump(arm) <= JOIN_TOLERANCE and largest_jump(gripper) <= JOIN_TOLERANCE


@njit(cache=True, fastmath={"reassoc"})
def all_finite(position, velocity, acceleration):
    """Whether three arrays (N+1, n) hold finite numbers only."""
    for array in (position, velocity, acceleration):
        # Nothing times a finite number is nothing. Summed up without a branch, for that becomes vector instructions.
        values, rest = array.ravel(), 0.0
        for i in range(values.size):
            rest += 0.0 * values[i]
        if rest != 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def write_state(trajectory, local, at_rest, state):
    """See `Trajectory.sample_as`; state (3, n)."""
    interpolate(trajectory, np.full(1, local), state.reshape(3, 1, -1))
    if at_rest:
        state[1:] = 0.0


@njit(cache=True, error_model="numpy", inline="always")
def interval_at(t, duration, N):
    """Which of N intervals a time (s) falls into, clamped to the duration, and what share of it has passed then."""
    scaled = min(max(t, 0.0), duration) / (duration / N)
    k = max(min(int(scaled), N - 1), 0)
    return k, scaled - k


@njit(cache=True, error_model="numpy", inline="always")
def position_weights(step, s):
    """What q̇, q̈ and the change of q̈ over an interval of `step` (s) add to the position when a share s has passed."""
    return step * s, step**2 * s**2 / 2, step**2 * (s**3 / 6 + s / 12)


@njit(cache=True, error_model="numpy")
def interpolate(trajectory, times, out):
    """`Trajectory.sample_many` (3, M, n); compiled, for controllers and audits ask for little and often."""
    duration, position, velocity, acceleration = trajectory
    N, n = position.shape[0] - 1, position.shape[1]
    step = duration / N
    for m in range(times.size):
        k, s = interval_at(times[m], duration, N)
        if s == 0.0 or s == 1.0:
            # Most of what is asked for are grid points.
            for i in range(n):
                at = k + int(s)
                out[0, m, i], out[1, m, i], out[2, m, i] = position[at, i], velocity[at, i], acceleration[at, i]
            continue
        (by_rate, half, sixth), gain = position_weights(step, s), step * s**2 / 2
        for i in range(n):
            v_k = acceleration[k, i]
            dv = acceleration[k + 1, i] - v_k
            out[0, m, i] = position[k, i] + by_rate * velocity[k, i] + half * v_k + sixth * dv
            out[1, m, i] = velocity[k, i] + by_rate * v_k + gain * dv
            out[2, m, i] = v_k + s * dv


@njit(cache=True, error_model="numpy")
def largest_defect(trajectory):
    """`Trajectory.dynamics_defect`; a NaN is the largest."""
    duration, position, velocity, acceleration = trajectory
    half_step, n = duration / (position.shape[0] - 1) / 2, position.shape[1]
    q, w, v = position.ravel(), velocity.ravel(), acceleration.ravel()
    in_q, in_w = (
        _violation(half_step, q[:-n], q[n:], w[:-n], w[n:]),
        _violation(half_step, w[:-n], w[n:], v[:-n], v[n:]),
    )
    return largest(np.array([in_q, in_w]))


@njit(cache=True, error_model="numpy")
def _violation(half_step, x, x_next, rate, rate_next):
    """Largest |x′ − x − Δt/2 (ẋ′ + ẋ)| of arrays (M,) and their values one grid point later."""
    defects = np.empty(x.size)
    for i in range(x.size):
        defects[i] = abs(x_next[i] - x[i] - half_step * (rate_next[i] + rate[i]))
    return largest(defects)


_ALL_BUT_SIGN = 0x7FFF_FFFF_FFFF_FFFF


@njit(cache=True)
def largest(values):
    """Largest of numbers (M,), M ≥ 1; a NaN without a sign is larger than all.

    Read as integers floats keep their order, once the negative ones are turned round. Comparisons of integers become
    vector instructions, while those of floats do not, for they have to mind NaNs.
    """
    bits, most = values.view(np.int64), np.int64(-_ALL_BUT_SIGN)
    for i in range(bits.size):
        most = max(most, bits[i] ^ ((bits[i] >> 63) & _ALL_BUT_SIGN))
    return np.full(1, most ^ ((most >> 63) & _ALL_BUT_SIGN)).view(np.float64)[0]
