"""Distances between the moving bodies, the part and the ground along a plan, from their collision geometry.

The least distance over all pairs of bodies and all samples is found without measuring most of them: compiled lower
bounds (`models.distance_bounds`) say which pair at which sample could be nearest, that one is measured exactly, and
what it shows bounds the samples around it; it ends when no bound is below the least distance measured. Hand and part
are nearest when it is taken, part and ground when it is lifted: that is measured first, and whatever is farther at
another time is left out.
"""

from __future__ import annotations

import itertools

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.bounding_volumes import Bodies, Pieces
from dyngrasp.models.distance_bounds import (
    add_near_each_other,
    add_near_ground,
    add_near_pieces,
    add_pieces_near_ground,
    lowest,
    space_for,
    tighten,
)
from dyngrasp.models.link_motion import Motion
from dyngrasp.planning.cell_geometry import CellGeometry, cell_geometry, motion_along
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import part_motion
from dyngrasp.planning.plan_samples import waypoints
from dyngrasp.planning.problem import AuditEntry
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan

# Distances above this (m) are not measured: the audit asks for contact, not for the exact width of a gap that nobody
# would call narrow.
HORIZON = 0.05

# The part stands on the ground when it is lifted; its own pieces may reach this far below z = 0 by rounding (m).
RESTING_TOLERANCE = 5e-4

# Most plans have fewer candidates; room for all there could be takes longer to come by than to look at them.
_FEW = 128

# Coal's iterations stop within this of the distance (m); bounds that are nearer to each other say nothing.
RESOLUTION = 1e-6

# Which of `Motion.paths`.
_IN_WORLD, _FROM_PART = 0, 1

# Least distance (m, negative for penetration), the sample at which it occurs, and whose it is.
Nearest = tuple[float, int, str]


def clearance_entries(
    task: GraspTask, targets: GraspTargets, plan: GraspPlan, since: float = -np.inf
) -> list[AuditEntry]:
    """Least distances along a plan: to the ground, to the part outside the intended contact, of the arm to itself.

    Args:
        task: Arm, gripper and part.
        targets: Where the part stands and how it is taken.
        plan: Any plan.
        since: What comes before this time (s) is not looked at.

    Returns:
        Entries "ground_clearance", "part_clearance", "self_clearance" and, for the carried part against ground and
        arm, "carried_clearance"; distances above `HORIZON` are reported as `HORIZON`.
    """
    cell = cell_geometry(task, targets.grasp.name)
    times, closing, lifted, motion, sunk, finite, found, taken, hanging = _at_the_grasp(
        *plan.arrays, since, part_motion(targets), task.grasp_object.underside, cell.rows, cell.kinematics,
        cell.volumes, cell.is_pad,
    )  # fmt: skip
    if finite:
        part = _nearest(cell, motion, found, (0, taken), _FROM_PART, (HORIZON, 0, ""))
        carried = _nearest(cell, motion, found, (taken, hanging), _IN_WORLD, (HORIZON, lifted, ""))
        found, groups = _anywhere(
            motion, closing, lifted, part[0] - RESOLUTION, carried[0] - RESOLUTION, cell.volumes, cell.link_pairs,
            cell.is_pad, cell.on_arm,
        )  # fmt: skip
        ground = itself = HORIZON, 0, ""
        if groups[-1] > 0:
            on_the_way, above, between, later, arm = itertools.pairwise(groups)
            part = _nearest(cell, motion, found, on_the_way, _FROM_PART, part)
            ground = _nearest(cell, motion, found, above, _IN_WORLD, ground)
            itself = _nearest(cell, motion, found, between, _IN_WORLD, itself)
            carried = _nearest(cell, motion, found, later, _IN_WORLD, carried)
            carried = _nearest(cell, motion, found, arm, _FROM_PART, carried)
    else:
        ground = part = itself = carried = np.nan, 0, "a motion that is not finite"
    return [
        _entry("ground_clearance", ground, 0.0, 0.0, times),
        _entry("part_clearance", part, 0.0, 0.0, times),
        _entry("self_clearance", itself, 0.0, 0.0, times),
        # So deep as an estimate puts the standing part into the ground it may hang when it is lifted.
        _entry("carried_clearance", carried, -sunk, RESTING_TOLERANCE, times),
    ]


def _entry(name: str, found: Nearest, bound: float, tolerance: float, times: Array) -> AuditEntry:
    distance, k, who = found
    return AuditEntry(name, distance, bound, True, tolerance, "m", float(times[k]), who)


@njit(cache=True, error_model="numpy")
def _at_the_grasp(arm, gripper, ends, since, part, underside, rows, kinematics, volumes, is_pad):
    """How all moves, and what is near when the part is taken and lifted.

    Returns:
        Times (S,); the samples from which on the pads may touch the part and from which on it hangs; `Motion`; how far
        an estimate puts the standing part into the ground (m); whether all is finite; `Candidates` within `HORIZON`,
        hand and part at the last sample before it hangs, part and ground at the next one; how many of the first kind;
        of both.
    """
    bodies, pieces = Bodies(*volumes[0]), Pieces(*volumes[1])
    times, q, closing, lifted = waypoints(arm, gripper, ends, since, rows)
    motion, finite = motion_along(q, times, lifted, part, kinematics)
    most = pieces.low.shape[1] * (bodies.radii.size + 1)
    found, taken, hanging, last = space_for(most), 0, 0, max(lifted - 1, 0)
    if finite:
        windows = _until_closing(bodies, is_pad, closing, last, last + 1)
        taken = add_near_pieces(motion, bodies, pieces, windows, HORIZON, found, 0)
        hanging = add_pieces_near_ground(motion, pieces, (lifted, lifted + 1), HORIZON, found, taken)
    return (
        times, closing, lifted, (motion.R, motion.p, motion.paths), _sunk(part, underside), finite,
        (found.which[:hanging], found.bounds[:hanging]), taken, hanging,
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _anywhere(motion, closing, lifted, near_part, near_ground, volumes, link_pairs, is_pad, on_arm):
    """`Candidates` at all samples, and where those of each kind begin and the last ones end.

    First hand and part within `near_part` (m), then arm and hand with the ground and with themselves within `HORIZON`,
    then, within `near_ground` (m), the lifted part with the ground and with the arm.
    """
    motion, bodies, pieces = Motion(*motion), Bodies(*volumes[0]), Pieces(*volumes[1])
    samples, room = motion.p.shape[2], _FEW
    on_the_way = _until_closing(bodies, is_pad, closing, 0, samples)
    by_arm = np.full((on_arm.size, 2), samples)
    for b in range(on_arm.size):
        if on_arm[b]:
            by_arm[b, 0] = lifted
    while True:
        found = space_for(room)
        part = add_near_pieces(motion, bodies, pieces, on_the_way, near_part, found, 0)
        ground = add_near_ground(motion, bodies, HORIZON, found, part)
        itself = add_near_each_other(motion, bodies, link_pairs, HORIZON, found, ground)
        hanging = add_pieces_near_ground(motion, pieces, (lifted, samples), near_ground, found, itself)
        arm = add_near_pieces(motion, bodies, pieces, by_arm, near_ground, found, hanging)
        if arm >= 0:
            return (found.which[:arm], found.bounds[:arm]), (0, part, ground, itself, hanging, arm)
        room *= 8


@njit(cache=True)
def _until_closing(bodies, is_pad, closing, first, stop):
    """(B, 2) samples from one to before another at which each body counts against the part; pads do until they close.

    What does not move is where it is meant to be.
    """
    windows = np.empty((is_pad.size, 2), np.int64)
    for b in range(is_pad.size):
        windows[b, 0] = first if b >= bodies.firsts[1] else stop
        windows[b, 1] = min(closing, stop) if is_pad[b] else stop
    return windows


@njit(cache=True)
def _sunk(part, underside):
    """How far the standing part (of `part_motion`) reaches into the ground with corners (C, 3) of its underside (m)."""
    rotation, position = part[0], part[1]
    deepest = 0.0
    for corner in underside:
        z = position[2] + rotation[2, 0] * corner[0] + rotation[2, 1] * corner[1] + rotation[2, 2] * corner[2]
        deepest = max(deepest, -z)
    return deepest


def _nearest(
    cell: CellGeometry,
    motion: tuple[Array, Array, Array],
    found: tuple[NDArray[np.int64], Array],
    group: tuple[int, int],
    frame: int,
    best: Nearest,
) -> Nearest:
    """The nearest of a group of pairs, or `best` if none comes nearer than that.

    Args:
        cell: The bodies.
        motion: What makes up the `Motion` of their links.
        found: What makes up `Candidates`; each that is measured raises the bounds of its neighbours.
        group: The first that counts, and one after the last.
        frame: Which of the paths bound how much their distances change.
        best: What is known already.
    """
    if group[0] == group[1]:
        return best
    (R, p, paths), (which, bounds) = motion, found
    paths, at = paths[frame], lowest(bounds, group)
    while bounds[at] < best[0] - RESOLUTION:
        i, j, k = which[at].tolist()
        distance = cell.distance(i, j, R, p, k)
        if not distance >= best[0]:
            best = distance, k, f"{cell.names[i]} and {cell.names[j]}"
        at = tighten(found, group, at, distance, paths[cell.links[i]], paths[cell.links[j]])
    return best
