"""Distances between the moving bodies, the part and the ground along a plan, from their collision geometry (Coal).

The least distance over all pairs of bodies and all samples is found without measuring most of them: compiled lower
bounds (`models.distance_bounds`) say which pair at which sample could be nearest, that one is measured exactly, and
what it shows bounds the samples around it; it ends when no bound is below the least distance measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import trimesh
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.batch_dynamics import BatchModel
from dyngrasp.models.distance_bounds import (
    Capsules,
    Tracks,
    bounding_capsule,
    box_heights,
    heights,
    near_boxes,
    near_capsules,
    seen_from,
    tighten,
    tracks,
)
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import AuditEntry
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import GraspPlan, Trajectory, largest_difference

Indices = NDArray[np.intp]

# Distances above this (m) are not measured: the audit asks for contact, not for the exact width of a gap that nobody
# would call narrow.
HORIZON = 0.05

# The hand moves at most this far (rad of any joint) between two samples: about a centimetre at the finger tips.
JOINT_STEP = 0.015

# The part stands on the ground when it is lifted; its own pieces may reach this far below z = 0 by rounding (m).
RESTING_TOLERANCE = 5e-4

# Coal's iterations stop within this of the distance (m); bounds that are nearer to each other say nothing.
RESOLUTION = 1e-6

# Joints between two bodies below which they cannot meet, or always touch.
APART = 3


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Where a plan is looked at: times (S,) on its clock, arm (n, S) and gripper (m, S) positions.

    From sample `closing` on the pads may touch the part, from `lifted` on it hangs in the gripper.
    """

    times: Array
    q: Array
    q_h: Array
    closing: int
    lifted: int


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs that may come near: geometry and frame of both, lower bounds and combined path along the samples.

    Attributes:
        first, second: (K,) bodies by index into `CellGeometry.names`.
        bounds: (K, S) lower bounds of the distance (m), inf where a sample does not count.
        travel: (K, S) path by which both have approached each other since the first sample, at most (m).
    """

    first: Indices
    second: Indices
    bounds: Array
    travel: Array


class CellGeometry:
    """Arm, gripper, part and ground as collision bodies; the part stands in the world or hangs in the gripper.

    Bodies are numbered: those of arm and hand (`moving` of them move), the pieces of the part, the ground.

    Args:
        task: Arm, gripper and part.
        grasp: How the part hangs in the gripper once it is taken.
    """

    def __init__(self, task: GraspTask, grasp: Grasp) -> None:
        self.assembly: Assembly = assemble(task.robot, task.gripper)
        model, bodies = self.assembly.pin_model, list(self.assembly.geometry.geometryObjects)
        # The model of the whole lives as long as its bodies, which refer to it.
        self._geometry = self.assembly.geometry
        self.tree = BatchModel.from_pinocchio(model)
        # Last of the frames is the flange: its motion is the carried part's.
        flange = model.frames[self.assembly.flange_id]
        self.frames = self.tree.attach(
            [(joint, pin.SE3.Identity()) for joint in range(model.njoints)]
            + [(int(flange.parentJoint), pin.SE3(flange.placement))]
        )
        pieces = [_convex(path) for path in task.grasp_object.piece_paths]
        self.ground = len(bodies) + len(pieces)
        self.names = [body.name for body in bodies] + [path.stem for path in task.grasp_object.piece_paths] + ["ground"]
        self.shapes = [body.geometry for body in bodies]
        self.shapes += [shape for shape, _ in pieces] + [coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)]
        self.links = np.array([int(body.parentJoint) for body in bodies], dtype=np.int64)
        self.placements = [coal.Transform3s(body.placement.rotation, body.placement.translation) for body in bodies]
        self.capsules = self._capsules(bodies)
        self.low = read_only([points.min(axis=0) for _, points in pieces])
        self.high = read_only([points.max(axis=0) for _, points in pieces])
        self._group(task)
        T_flange_grasp = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(task.closed_posture(grasp))
        self.T_flange_object = T_flange_grasp * grasp.T_object_grasp.inverse()
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()

    def _capsules(self, bodies: list[pin.GeometryObject]) -> Capsules:
        ends, radii = [], []
        for body in bodies:
            segment, radius = bounding_capsule(body.geometry)
            ends.append([body.placement.act(end) for end in segment])
            radii.append(radius)
        return Capsules(self.links, read_only(ends), read_only(radii))

    def _group(self, task: GraspTask) -> None:
        """Which bodies belong together, as indices."""
        hand, pads = set(self.assembly.hand_geoms), set(self.assembly.pad_geoms)
        on_hand = np.array([name in hand for name in self.names[: len(self.links)]])
        self.is_pad = np.array([name in pads for name in self.names[: len(self.links)]])
        moving = (self.links > 0) | on_hand
        self.moving = np.flatnonzero(moving)
        self.arm_and_base = np.flatnonzero(~on_hand)
        # The hand counts as the last link; what is fewer joints apart touches by construction or cannot meet.
        link = np.where(on_hand, task.robot.n, np.minimum(self.links, task.robot.n))
        first, second = np.nonzero(link[None, :] - link[:, None] >= APART)
        self.self_pairs = first.astype(np.int64), second.astype(np.int64)

    def poses(self, q: Array, q_h: Array) -> tuple[Array, Array]:
        """Poses of all links (world first) and the flange (last): (L, 3, 3, S), (L, 3, S), for (n, S), (m, S)."""
        both = np.empty((self.tree.parents.size, q.shape[1]))
        both[self.assembly.arm_indices], both[self.assembly.hand_indices] = q, q_h
        return self.tree.poses(both, self.frames)

    def nearest(self, pairs: Candidates, scene: Scene) -> tuple[float, int, str]:
        """Least distance (m, negative for penetration) among `pairs`, its sample and whose it is.

        `HORIZON`, the first sample and nobody if nothing comes nearer than that.
        """
        best, sample, name = HORIZON, 0, ""
        if not len(pairs.bounds):
            return best, sample, name
        where = pairs.bounds.argmin(axis=1)
        least = pairs.bounds[np.arange(where.size), where]
        while True:
            row = int(least.argmin())
            if least[row] >= best - RESOLUTION:
                return best, sample, name
            k, i, j = int(where[row]), int(pairs.first[row]), int(pairs.second[row])
            distance = self.distance(i, j, scene, k)
            if not distance >= best:
                best, sample, name = distance, k, f"{self.names[i]} and {self.names[j]}"
            least[row], where[row] = tighten(pairs.bounds[row], pairs.travel[row], k, distance)

    def distance(self, i: int, j: int, scene: Scene, k: int) -> float:
        """Exact distance of two bodies at sample k (m)."""
        self.result.clear()
        return coal.distance(
            self.shapes[i], self._at(i, scene, k), self.shapes[j], self._at(j, scene, k), self.request, self.result
        )

    def _at(self, i: int, scene: Scene, k: int) -> coal.Transform3s:
        if i < len(self.links):
            link = self.links[i]
            return coal.Transform3s(scene.R[link, :, :, k], scene.p[link, :, k]) * self.placements[i]
        if i == self.ground:
            return coal.Transform3s()
        return coal.Transform3s(scene.R_part[:, :, k], scene.p_part[:, k])


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses at S samples: links (L, 3, 3, S), (L, 3, S) and part (3, 3, S), (3, S), which is carried from `lifted` on.

    `closing` is the first sample at which the pads may touch the part.
    """

    R: Array
    p: Array
    R_part: Array
    p_part: Array
    closing: int
    lifted: int


def _convex(path: Path) -> tuple[coal.Convex, Array]:
    """A convex piece for Coal, and its vertices (V, 3)."""
    hull = trimesh.load_mesh(path).convex_hull
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        points.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(points, faces), np.asarray(hull.vertices)


@lru_cache(maxsize=8)
def cell_geometry(task: GraspTask, grasp_name: str) -> CellGeometry:
    """The bodies of a task, made once."""
    return CellGeometry(task, next(g for g in task.grasp_object.grasps if g.name == grasp_name))


def clearance_entries(task: GraspTask, targets: GraspTargets, waypoints: Waypoints) -> list[AuditEntry]:
    """Least distances along a plan: to the ground, to the part outside the intended contact, of the arm to itself.

    Args:
        task: Arm, gripper and part.
        targets: Where the part stands and how it is taken.
        waypoints: Samples of the plan, from `waypoints_of`.

    Returns:
        Entries "ground_clearance", "part_clearance", "self_clearance" and, for the carried part against ground and
        arm, "carried_clearance"; distances above `HORIZON` are reported as `HORIZON`.
    """
    cell = cell_geometry(task, targets.grasp.name)
    scene = _scene(cell, waypoints, targets)
    # Comparisons would lose a NaN on the way to the least distance.
    if not all(np.isfinite(x.sum()) for x in (waypoints.times, scene.R, scene.p, scene.R_part, scene.p_part)):
        found = dict.fromkeys(_CHECKS, (np.nan, 0, "a motion that is not finite"))
    else:
        world = tracks(scene.R, scene.p, cell.capsules)
        seen = tracks(*seen_from(scene.R_part, scene.p_part, scene.R, scene.p), cell.capsules)
        candidates = (
            _over_ground(cell, world),
            _near_part(cell, scene, seen),
            _within_arm(cell, world),
            _carried(cell, scene, seen),
        )
        found = {name: cell.nearest(pairs, scene) for name, pairs in zip(_CHECKS, candidates, strict=True)}
        # The part hangs in the gripper only from the lift on.
        distance, k, who = found["carried_clearance"]
        found["carried_clearance"] = distance, max(k, scene.lifted), who
    bounds = dict.fromkeys(_CHECKS, 0.0) | {"carried_clearance": -_sunk(task, targets)}
    return [
        AuditEntry(name, distance, bounds[name], True, _CHECKS[name], "m", float(waypoints.times[k]), who)
        for name, (distance, k, who) in found.items()
    ]


def _sunk(task: GraspTask, targets: GraspTargets) -> float:
    """How far an estimate puts the standing part into the ground (m): so deep it may hang when it is lifted."""
    T, corners = targets.T_world_object, task.grasp_object.underside
    return max(0.0, -float((corners @ T.rotation[2] + T.translation[2]).min()))


# Entries and their tolerances (m).
_CHECKS = {
    "ground_clearance": 0.0,
    "part_clearance": 0.0,
    "self_clearance": 0.0,
    "carried_clearance": RESTING_TOLERANCE,
}


def _scene(cell: CellGeometry, waypoints: Waypoints, targets: GraspTargets) -> Scene:
    R, p = cell.poses(waypoints.q, waypoints.q_h)
    lifted, T = waypoints.lifted, cell.T_flange_object
    R_part, p_part = np.empty(R.shape[1:]), np.empty(p.shape[1:])
    standing = targets.part_poses(waypoints.times[:lifted])
    R_part[..., :lifted], p_part[..., :lifted] = np.moveaxis(standing[0], 0, -1), standing[1].T
    R_flange, p_flange = R[-1, :, :, lifted:], p[-1, :, lifted:]
    R_part[..., lifted:] = np.einsum("abs,bc->acs", R_flange, T.rotation)
    p_part[..., lifted:] = p_flange + np.einsum("abs,b->as", R_flange, T.translation)
    return Scene(R, p, R_part, p_part, waypoints.closing, lifted)


def _over_ground(cell: CellGeometry, world: Tracks) -> Candidates:
    bounds = heights(world.ends, cell.capsules.radii, cell.moving)
    return Candidates(cell.moving, np.full(cell.moving.size, cell.ground), bounds, world.travel[cell.moving])


def _near_part(cell: CellGeometry, scene: Scene, seen: Tracks) -> Candidates:
    """Arm and hand against the pieces; the pads only until they close."""
    samples = scene.p.shape[2]
    stops = np.where(cell.is_pad[cell.moving], scene.closing, samples)
    return _to_pieces(cell, seen, cell.moving, np.zeros_like(stops), stops)


def _to_pieces(cell: CellGeometry, seen: Tracks, bodies: Indices, starts: Indices, stops: Indices) -> Candidates:
    first, box, bounds = near_boxes(
        seen.ends, seen.travel, cell.capsules.radii, bodies, starts, stops, cell.low, cell.high, HORIZON
    )
    return Candidates(first, len(cell.links) + box, bounds, seen.travel[first])


def _within_arm(cell: CellGeometry, world: Tracks) -> Candidates:
    first, second = cell.self_pairs
    kept, bounds = near_capsules(world.ends, world.travel, cell.capsules.radii, first, second, HORIZON)
    first, second = first[kept], second[kept]
    return Candidates(first, second, bounds, world.travel[first] + world.travel[second])


def _carried(cell: CellGeometry, scene: Scene, seen: Tracks) -> Candidates:
    """The pieces of the part against arm, base and ground, once it is lifted."""
    bodies, samples = cell.arm_and_base, scene.p.shape[2]
    starts, stops = np.full(bodies.size, scene.lifted), np.full(bodies.size, samples)
    arm = _to_pieces(cell, seen, bodies, starts, stops)
    bounds = box_heights(scene.R_part[2], scene.p_part[2], cell.low, cell.high, scene.lifted)
    pieces = np.arange(len(cell.low)) + len(cell.links)
    # A height above the ground is bounded well enough at every sample by itself.
    apart: Array = np.tile(np.arange(samples) * 1e9, (pieces.size, 1)).astype(float)
    return Candidates(
        np.concatenate([arm.first, pieces]),
        np.concatenate([arm.second, np.full(pieces.size, cell.ground)]),
        np.concatenate([arm.bounds, bounds]),
        np.concatenate([arm.travel, apart]),
    )


def waypoints_of(plan: GraspPlan, since: float = -np.inf) -> Waypoints:
    """Samples of a plan from `since` (s) on, `JOINT_STEP` or less apart, with both ends of each phase."""
    tables, counts = [], []
    for arm, gripper, T in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), strict=True):
        start = since - (T - arm.duration)
        local = _equidistant(arm, gripper, max(start, 0.0)) if since < T else np.empty(0)
        tables.append((T - arm.duration + local, arm.sample_many(local)[0], gripper.sample_many(local)[0]))
        counts.append(local.size)
    times, q, q_h = (np.concatenate(column) for column in zip(*tables, strict=True))
    return Waypoints(times, np.ascontiguousarray(q.T), np.ascontiguousarray(q_h.T), counts[0], counts[0] + counts[1])


def _equidistant(arm: Trajectory, gripper: Trajectory, start: float) -> Array:
    """Times of a phase, from `start` (s) to its end, between which no joint moves by more than `JOINT_STEP`."""
    finer = max(arm.intervals, gripper.intervals)
    grid = arm.times if arm.intervals == finer else gripper.times
    both = [x.position if x.intervals == finer else x.sample_many(grid)[0] for x in (arm, gripper)]
    return _times_along(grid, both[0], both[1], start, JOINT_STEP)


@njit(cache=True)
def _times_along(grid, q, q_h, start, joint_step):
    """Times from `start` to the last of `grid` (M,), equidistant on the path of q (M, n) and q_h (M, m).

    The path counts in the largest joint step of each interval (rad).
    """
    last = grid.size - 1
    path = np.zeros(grid.size)
    for k in range(last):
        # Where both stand still the path needs a slope too, for times to be read from it.
        path[k + 1] = path[k] + largest_difference(q[k + 1], q[k]) + largest_difference(q_h[k + 1], q_h[k]) + 1e-9
    if not np.isfinite(path[last]):
        # A number that is none is looked at.
        return grid[grid >= start]
    begin = np.interp(start, grid, path)
    count = max(int(np.ceil((path[last] - begin) / joint_step)), 1)
    times = np.interp(begin + (path[last] - begin) / count * np.arange(count + 1), path, grid)
    times[0], times[count] = start, grid[last]
    return times
