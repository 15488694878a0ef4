"""Distances between the moving bodies, the part and the ground along a plan, from their collision geometry.

The least distance over all pairs of bodies and all samples is found without measuring most of them: compiled lower
bounds (`models.distance_bounds`) say which pair at which sample could be nearest, that one is measured exactly, and
what it shows bounds the samples around it; it ends when no bound is below the least distance measured.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.distance_bounds import (
    Candidates,
    add_near_each_other,
    add_near_ground,
    add_near_pieces,
    add_pieces_near_ground,
    first_of,
    lowest,
    nearest_pair,
    space_for,
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

# Most plans have fewer pairs that come near; room for all there could be takes longer to come by than to look at them.
_FEW = 128

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
    closing, lifted = waypoints.closing, waypoints.lifted
    windows = _windows(cell.bodies.links, cell.is_pad, cell.on_arm, closing, lifted, waypoints.times.size)
    found, least, groups = _candidates(world, seen, cell.bodies, cell.pieces, cell.link_pairs, windows, lifted)
    taken, ground, itself, lifted_part, arm_at_part = itertools.pairwise(groups)
    search, nobody = Search(cell, world, found, least), (HORIZON, 0, "")
    # When the part is taken the hand is nearer to it than on the way: what is farther then need not be looked at.
    closest = search.nearest(taken, seen, nobody)
    on_the_way, at = _candidates_at_part(seen, cell.bodies, cell.pieces, windows[1], closest[0])
    carried = search.nearest(lifted_part, world, (HORIZON, lifted, ""))
    return [
        search.nearest(ground, world, nobody),
        Search(cell, world, on_the_way, at).nearest((0, at.size), seen, closest),
        search.nearest(itself, world, nobody),
        # The part hangs in the gripper only from the lift on.
        search.nearest(arm_at_part, seen, carried),
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


@njit(cache=True)
def _candidates(world, seen, bodies, pieces, link_pairs, windows, lifted):
    """Pairs within `HORIZON`, the lowest bound of each, and where the pairs of each kind begin and the last ones end.

    First those of the hand and the part as it is taken, then of arm and hand with the ground, with themselves, of the
    lifted part with the ground, with the arm.
    """
    samples, bodies_by_pieces = world.p.shape[2], bodies.radii.size * pieces.reaches.size
    most = 2 * bodies_by_pieces + bodies.radii.size * (bodies.radii.size + 1) + pieces.reaches.size
    for pairs in (_FEW, most):
        found = space_for(pairs, pairs * samples)
        taken = add_near_pieces(seen, bodies, pieces, windows[0], HORIZON, found, 0)
        ground = add_near_ground(world, bodies, HORIZON, found, taken)
        itself = add_near_each_other(world, bodies, link_pairs, HORIZON, found, ground)
        lifted_part = add_pieces_near_ground(world, pieces, lifted, HORIZON, found, itself)
        arm = add_near_pieces(seen, bodies, pieces, windows[2], HORIZON, found, lifted_part)
        if arm >= 0:
            break
    found = first_of(found, arm)
    return found, lowest(found.stops, found.bounds), (0, taken, ground, itself, lifted_part, arm)


@njit(cache=True)
def _candidates_at_part(seen, bodies, pieces, window, horizon):
    """Pairs of the hand and the part within a horizon (m), and the lowest bound of each."""
    samples, count = seen.p.shape[2], 0
    for pairs in (_FEW, bodies.radii.size * pieces.reaches.size):
        found = space_for(pairs, pairs * samples)
        count = add_near_pieces(seen, bodies, pieces, window, horizon, found, 0)
        if count >= 0:
            break
    found = first_of(found, count)
    return found, lowest(found.stops, found.bounds)


@dataclass
class Search:
    """Exact distances of some pairs of bodies, nearest first; each that is measured raises the bounds of its pair.

    Attributes:
        cell: The bodies.
        world: Motion of their links as seen from the world.
        found: Pairs and the bounds of their distances.
        least: (K,) of `lowest`.
    """

    cell: CellGeometry
    world: Motion
    found: Candidates
    least: NDArray[np.int64]

    def nearest(self, group: tuple[int, int], motion: Motion, best: Nearest) -> Nearest:
        """The nearest of the pairs from one to another, or `best` if none comes nearer than that.

        Args:
            group: First pair, and one after the last.
            motion: What their bounds rest on.
            best: What is known already.
        """
        cell, world, found, least = self.cell, self.world, self.found, self.least
        while group[0] < group[1]:
            pair, bound = nearest_pair(least, found.bounds, *group)
            if bound >= best[0] - RESOLUTION:
                break
            i, j = found.pairs[pair].tolist()
            k = int(found.samples[least[pair]])
            distance = cell.distance(i, j, world.R, world.p, k)
            if not distance >= best[0]:
                best = distance, k, f"{cell.names[i]} and {cell.names[j]}"
            own = slice(found.stops[pair], found.stops[pair + 1])
            one, other = (motion.path(cell.links[body], cell.reaches[body]) for body in (i, j))
            at = least[pair] - own.start
            least[pair] = own.start + tighten(found.samples[own], found.bounds[own], one, other, at, distance)
        return best


def _sunk(task: GraspTask, targets: GraspTargets) -> float:
    """How far an estimate puts the standing part into the ground (m): so deep it may hang when it is lifted."""
    T, corners = targets.T_world_object, task.grasp_object.underside
    return max(0.0, -float((corners @ T.rotation[2] + T.translation[2]).min()))
