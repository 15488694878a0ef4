"""Distances between the moving bodies, the part and the ground along a plan, from their collision geometry.

The least distance over all pairs of bodies and all samples is found without measuring most of them: compiled lower
bounds (`models.distance_bounds`) say which pair at which sample could be nearest, that one is measured exactly, and
what it shows bounds the samples around it; it ends when no bound is below the least distance measured.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.models.distance_bounds import (
    Candidates,
    lowest,
    near_each_other,
    near_ground,
    near_pieces,
    nearest_pair,
    pieces_near_ground,
    tighten,
)
from dyngrasp.models.link_motion import Motion
from dyngrasp.planning.cell_geometry import WORLD, CellGeometry, cell_geometry
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import part_motion
from dyngrasp.planning.plan_samples import Waypoints
from dyngrasp.planning.problem import AuditEntry

# Distances above this (m) are not measured: the audit asks for contact, not for the exact width of a gap that nobody
# would call narrow.
HORIZON = 0.05

# The part stands on the ground when it is lifted; its own pieces may reach this far below z = 0 by rounding (m).
RESTING_TOLERANCE = 5e-4

# Coal's iterations stop within this of the distance (m); bounds that are nearer to each other say nothing.
RESOLUTION = 1e-6


def clearance_entries(task: GraspTask, targets: GraspTargets, waypoints: Waypoints) -> list[AuditEntry]:
    """Least distances along a plan: to the ground, to the part outside the intended contact, of the arm to itself.

    Args:
        task: Arm, gripper and part.
        targets: Where the part stands and how it is taken.
        waypoints: Samples of the plan.

    Returns:
        Entries "ground_clearance", "part_clearance", "self_clearance" and, for the carried part against ground and
        arm, "carried_clearance"; distances above `HORIZON` are reported as `HORIZON`.
    """
    cell, times = cell_geometry(task, targets.grasp.name), waypoints.times
    world, seen, finite = cell.motions(waypoints, part_motion(targets))
    if finite:
        found = _checked(cell, waypoints, world, seen)
    else:
        found = [(np.nan, 0, "a motion that is not finite")] * len(_CHECKS)
    bounds = 0.0, 0.0, 0.0, -_sunk(task, targets)
    return [
        AuditEntry(name, distance, bound, True, tolerance, "m", float(times[k]), who)
        for (name, tolerance), bound, (distance, k, who) in zip(_CHECKS, bounds, found, strict=True)
    ]


# Entries and their tolerances (m), in the order of `_checked`.
_CHECKS = (
    ("ground_clearance", 0.0),
    ("part_clearance", 0.0),
    ("self_clearance", 0.0),
    ("carried_clearance", RESTING_TOLERANCE),
)


# Least distance (m, negative for penetration), the sample at which it occurs, and whose it is.
Nearest = tuple[float, int, str]


def _checked(cell: CellGeometry, waypoints: Waypoints, world: Motion, seen: Motion) -> list[Nearest]:
    """What each check finds, for motion as seen from the world and from the part.

    `HORIZON`, the first sample and nobody if nothing comes nearer than that.
    """
    bodies, pieces, lifted = cell.bodies, cell.pieces, waypoints.lifted
    windows = _windows(bodies.links, cell.is_pad, cell.on_arm, waypoints.closing, lifted, waypoints.times.size)
    nobody = HORIZON, 0, ""
    # When the part is taken the hand is nearer to it than on the way: what is farther then need not be looked at.
    closest = _nearest(cell, near_pieces(seen, bodies, pieces, windows[0], HORIZON), seen, world, nobody)
    carried = _nearest(cell, pieces_near_ground(world, pieces, lifted, HORIZON), world, world, (HORIZON, lifted, ""))
    return [
        _nearest(cell, near_ground(world, bodies, HORIZON), world, world, nobody),
        _nearest(cell, near_pieces(seen, bodies, pieces, windows[1], closest[0]), seen, world, closest),
        _nearest(cell, near_each_other(world, bodies, cell.link_pairs, HORIZON), world, world, nobody),
        # The part hangs in the gripper only from the lift on.
        _nearest(cell, near_pieces(seen, bodies, pieces, windows[2], carried[0]), seen, world, carried),
    ]


@njit(cache=True)
def _windows(links, is_pad, on_arm, closing, lifted, samples):
    """(3, B, 2) first sample at which each body counts against the part, and one after the last.

    When the part is taken; all the time until then and after it; the arm's, for a part that hangs.
    """
    windows, taken = np.empty((3, links.size, 2), np.int64), max(lifted - 1, 0)
    for b in range(links.size):
        # What does not move is where it is meant to be; the pads count until they close.
        first, last = 0 if links[b] != WORLD else samples, closing if is_pad[b] else samples
        windows[0, b] = max(first, taken), min(last, taken + 1)
        windows[1, b] = first, last
        windows[2, b] = lifted if on_arm[b] else samples, samples
    return windows


def _nearest(cell: CellGeometry, found: Candidates, motion: Motion, world: Motion, best: Nearest) -> Nearest:
    """The nearest of some pairs, or `best` if none comes nearer than that; `motion` is what their bounds rest on."""
    if not len(found.pairs):
        return best
    least = lowest(found.stops, found.bounds)
    while True:
        pair, bound = nearest_pair(least, found.bounds)
        if bound >= best[0] - RESOLUTION:
            return best
        i, j = found.pairs[pair].tolist()
        k = int(found.samples[least[pair]])
        distance = cell.distance(i, j, world.R, world.p, k)
        if not distance >= best[0]:
            best = distance, k, f"{cell.names[i]} and {cell.names[j]}"
        own = slice(found.stops[pair], found.stops[pair + 1])
        one, other = (motion.path(cell.links[body], cell.reaches[body]) for body in (i, j))
        at = least[pair] - own.start
        least[pair] = own.start + tighten(found.samples[own], found.bounds[own], one, other, at, distance)


def _sunk(task: GraspTask, targets: GraspTargets) -> float:
    """How far an estimate puts the standing part into the ground (m): so deep it may hang when it is lifted."""
    T, corners = targets.T_world_object, task.grasp_object.underside
    return max(0.0, -float((corners @ T.rotation[2] + T.translation[2]).min()))
