"""The table that an audit fills: one row a constraint, with its worst value, its time and whose it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dyngrasp.motion_arrays import JOIN_TOLERANCE

# Rounding of a ratio to a limit after a solver that stops at 1e-8 in its own scaling.
RATIO_TOLERANCE = 1e-6

# Rounding of a length (m): ten times below what any sensor or actuator of the cell resolves.
LENGTH_TOLERANCE = 1e-6

# The trapezoid between two grid points of a curved tube or funnel leaves it by a chord's height (m).
CHORD_TOLERANCE = 5e-5

# Rounding of an angle (rad), of which the hand's pose at the end of a phase may be off.
ANGLE_TOLERANCE = 1e-5


class Row(NamedTuple):
    """What a row is about.

    Attributes:
        name: Of the constraint.
        tolerance: Rounding allowed beyond its bound, in `unit`.
        unit: Of its values.
        at_least: Whether its bound is a lower one.
        of: Whose worst value it is: "phase", "arm" or "gripper" for their joints; nobody's in particular if empty.
    """

    name: str
    tolerance: float
    unit: str
    at_least: bool = False
    of: str = ""


ROWS = (
    Row("dynamics", 1e-9, "rad, rad/s", of="phase"),
    Row("join_position", JOIN_TOLERANCE, "rad"),
    Row("join_velocity", JOIN_TOLERANCE, "rad/s"),
    Row("pregrasp_position", LENGTH_TOLERANCE, "m"),
    Row("pregrasp_angle", ANGLE_TOLERANCE, "rad"),
    Row("grasp_position", LENGTH_TOLERANCE, "m"),
    Row("grasp_angle", ANGLE_TOLERANCE, "rad"),
    Row("place_position", LENGTH_TOLERANCE, "m"),
    Row("place_angle", ANGLE_TOLERANCE, "rad"),
    Row("lift_velocity", LENGTH_TOLERANCE, "m/s", at_least=True),
    Row("rest_at_place", JOIN_TOLERANCE, "rad/s"),
    Row("position", RATIO_TOLERANCE, "of limit", of="arm"),
    Row("velocity", RATIO_TOLERANCE, "of limit", of="arm"),
    Row("acceleration", RATIO_TOLERANCE, "of limit", of="arm"),
    Row("gripper_position", RATIO_TOLERANCE, "of limit", of="gripper"),
    Row("gripper_velocity", RATIO_TOLERANCE, "of limit", of="gripper"),
    Row("gripper_acceleration", RATIO_TOLERANCE, "of limit", of="gripper"),
    Row("torque", RATIO_TOLERANCE, "of limit", of="arm"),
    Row("funnel", CHORD_TOLERANCE, "m", at_least=True),
    Row("grasp_axis", CHORD_TOLERANCE, "m"),
    Row("grasp_dip", CHORD_TOLERANCE, "m", at_least=True),
    Row("grasp_tilt", 1e-4, "rad"),
    Row("hold", RATIO_TOLERANCE, "of the grip"),
)

DYNAMICS, JOIN, PREGRASP, LIFT, REST = 0, 1, 3, 9, 10
ARM, GRIPPER, TORQUE, FUNNEL, AXIS, DIP, TILT, HOLD = 11, 14, 17, 18, 19, 20, 21, 22


@njit(cache=True)
def empty_table():
    """(len(ROWS), 3): value, time (s) and number of whose it is; −1 for nobody's, where nothing was looked at."""
    return np.full((len(ROWS), 3), -1.0)


@njit(cache=True)
def enter(row, sign, value, time, whose):
    """Put a value into its row if it is worse than what is there: larger for `sign` 1, smaller for −1; NaN is worst."""
    if row[2] < 0.0 or (row[0] == row[0] and not sign * value <= sign * row[0]):
        row[0], row[1], row[2] = value, time, whose


def bounds_of(aside: float, below: float, turned: float) -> tuple[float, ...]:
    """Of each row, given the tolerances of the grasp (m, m, rad)."""
    bounds = [0.0] * ARM + [1.0] * (FUNNEL - ARM) + [0.0, aside, -below, turned, 1.0]
    return tuple(bounds)
