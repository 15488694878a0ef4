"""Arm, gripper, part and ground as collision bodies, how they move, and exact distances between them (Coal)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import trimesh
from numba import njit

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.batch_dynamics import BatchModel, compose, link_poses
from dyngrasp.models.bounding_volumes import bounding_bodies, boxes_around
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.models.link_motion import Motion, paths_from_part, paths_in_world, to_middles
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import part_poses
from dyngrasp.signals import Array, read_only

# Joints between two bodies below which they cannot meet, or always touch.
APART = 3

WORLD = 0  # the link that does not move; the ground belongs to it


class CellGeometry:
    """Arm, gripper, part and ground as collision bodies; the part stands in the world or hangs in the gripper.

    Bodies are numbered: those of arm and hand, the pieces of the part, the ground. So are links: the world, those of
    the joints of arm and hand, the part.

    Args:
        task: Arm, gripper and part.
        grasp: How the part hangs in the gripper once it is taken.

    Attributes:
        names: Of all bodies.
        shapes: The same for Coal.
        links: Link that carries each body.
        first_piece, ground: Numbers of bodies.
        bodies: Volumes around those of arm and hand.
        pieces: Volumes around the pieces of the part.
        link_pairs: (Q, 2) links whose bodies could meet.
        is_pad: (B,) bodies of the hand that touch the part when it is taken.
        on_arm: (B,) bodies of the arm and its base.
        rows: Rows of the joints of arm and hand among all.
        kinematics: What `motion_along` takes.
        volumes: Bodies and pieces as plain tuples, which compiled code is handed over in half the time.
        T_flange_part: How the part hangs.
    """

    def __init__(self, task: GraspTask, grasp: Grasp) -> None:
        self.assembly: Assembly = assemble(task.robot, task.gripper)
        model, geometry = self.assembly.pin_model, self.assembly.geometry
        self._tree = BatchModel.from_pinocchio(model)
        self.rows = self.assembly.arm_indices, self.assembly.hand_indices
        bodies = sorted(geometry.geometryObjects, key=lambda body: body.parentJoint)
        # The model of the whole lives as long as its bodies, which refer to it.
        self._geometry = geometry
        pieces = [_convex(path) for path in task.grasp_object.piece_paths]
        self._points = [points for _, points in pieces]
        self.first_piece, self.ground = len(bodies), len(bodies) + len(pieces)
        self.names = [body.name for body in bodies] + [path.stem for path in task.grasp_object.piece_paths] + ["ground"]
        self.shapes = [body.geometry for body in bodies]
        self.shapes += [shape for shape, _ in pieces] + [coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)]
        part, on_links = model.njoints, [int(body.parentJoint) for body in bodies]
        self.links = [*on_links, *(part for _ in pieces), WORLD]
        self._on_links = [
            self._turned(joint, pin.SE3(body.placement)) for joint, body in zip(on_links, bodies, strict=True)
        ]
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()
        T_flange_grasp = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(task.closed_posture(grasp))
        self.T_flange_part = T_flange_grasp * grasp.T_object_grasp.inverse()
        self.refresh()

    def _turned(self, joint: int, T: pin.SE3) -> pin.SE3:
        """A pose in the frame of a joint of Pinocchio's, in that of the link."""
        attached = self._tree.attach([(joint, T)])
        return pin.SE3(attached.rotations[0], attached.positions[0])

    def refresh(self) -> None:
        """Make what rests on `shapes` and `T_flange_part` anew, after one of these has been replaced."""
        assembly, count = self.assembly, self.first_piece
        hand, pads, n = set(assembly.hand_geoms), set(assembly.pad_geoms), assembly.robot.n
        on_hand = np.array([name in hand for name in self.names[:count]])
        links, moving = np.array(self.links[:count]), assembly.pin_model.njoints
        bodies, middles = bounding_bodies(self.shapes[:count], self._on_links, links, moving)
        pieces, middle = boxes_around(self._points, count)
        self.bodies, self.pieces, self.volumes = bodies, pieces, (tuple(bodies), tuple(pieces))
        middles = read_only([*middles, middle])
        placements = [*self._on_links, *(pin.SE3.Identity() for _ in self._points), pin.SE3.Identity()]
        self._placed = [
            coal.Transform3s(T.rotation, T.translation if link == WORLD else T.translation - middles[link])
            for T, link in zip(placements, self.links, strict=True)
        ]
        # The hand counts as the last link; what is fewer joints apart touches by construction or cannot meet.
        number = np.minimum(np.arange(moving), n)
        pairs = np.argwhere(number[None, :] - number[:, None] >= APART)
        self.link_pairs = pairs[np.isin(pairs, links).all(axis=1)].astype(np.int64)
        self.is_pad = np.array([name in pads for name in self.names[:count]])
        self.on_arm = ~on_hand
        flange = assembly.pin_model.frames[assembly.flange_id]
        carrier = int(flange.parentJoint)
        hanging = self._turned(carrier, pin.SE3(flange.placement) * self.T_flange_part)
        self.kinematics = (
            self._tree.tree, self.rows[1], (carrier, read_only(hanging.rotation), read_only(hanging.translation)),
            middles, read_only([*bodies.reaches, np.linalg.norm(pieces.around[1])]),
            read_only([*self._levers(carrier, middles, bodies.reaches), -1.0]),
        )  # fmt: skip

    def _levers(self, carrier: int, middles: Array, reaches: Array) -> list[float]:
        """How far from any joint between it and a carrier a link reaches (m); −1 for links that are not behind it."""
        levers, parents, offsets = [-1.0], self._tree.parents, self._tree.offsets
        for link in range(1, reaches.size):
            # From the link towards the carrier; the offset of the first joint behind that is no lever.
            lever, at, offset = 0.0, link, float(reaches[link] + np.linalg.norm(middles[link]))
            while at not in (carrier, WORLD):
                lever, offset = lever + offset, float(np.linalg.norm(offsets[at - 1]))
                at = int(parents[at - 1]) + 1
            levers.append(lever if at == carrier else -1.0)
        return levers

    def distance(self, i: int, j: int, R: Array, p: Array, k: int) -> float:
        """Exact distance of two bodies (m) at sample k of links (F, 3, 3, S), (F, 3, S) in the world."""
        self.result.clear()
        return coal.distance(
            self.shapes[i], self._at(i, R, p, k), self.shapes[j], self._at(j, R, p, k), self.request, self.result
        )

    def _at(self, i: int, R: Array, p: Array, k: int) -> coal.Transform3s:
        link = self.links[i]
        if link == WORLD:
            return self._placed[i]
        return coal.Transform3s(R[link, :, :, k], p[link, :, k]) * self._placed[i]


@lru_cache(maxsize=8)
def cell_geometry(task: GraspTask, grasp_name: str) -> CellGeometry:
    """The bodies of a task, made once."""
    return CellGeometry(task, next(g for g in task.grasp_object.grasps if g.name == grasp_name))


def _convex(path: Path) -> tuple[coal.Convex, Array]:
    """A convex piece for Coal, and its vertices (V, 3)."""
    hull = trimesh.load_mesh(path).convex_hull
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        points.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(points, faces), np.asarray(hull.vertices)


@njit(cache=True, error_model="numpy")
def motion_along(q, times, lifted, part, kinematics):
    """`Motion` of all links, and whether all of it is finite.

    Args:
        q: (n, S) joint positions (rad).
        times: (S,) on the clock that `part` refers to (s).
        lifted: First sample at which the part hangs in the hand.
        part: Of `part_motion`: where it is before.
        kinematics: Of a `CellGeometry`.
    """
    tree, hand, (carrier, turn, shift), middles, reaches, levers = kinematics
    links, samples = middles.shape[0], times.size
    R, p, paths = np.empty((links, 3, 3, samples)), np.empty((links, 3, samples)), np.empty((2, links, samples))
    p[WORLD], R[WORLD] = 0.0, 0.0
    for a in range(3):
        R[WORLD, a, a] = 1.0
    link_poses(q, tree, R[1:-1], p[1:-1])
    # The part stands or rides at the first samples, then it is fixed to a link.
    compose(R[carrier], p[carrier], turn, shift, R[-1], p[-1])
    part_poses(part, times[:lifted], R[-1], p[-1])
    to_middles(R, p, middles)
    paths_in_world(R, p, reaches, paths[0])
    paths_from_part(paths[0], q, hand, levers, lifted, paths[1])
    # Comparisons would lose a NaN on the way to the least distance; the paths are sums over all samples.
    finite = np.isfinite(paths[0, :, -1].sum() + times.sum() + p[:, :, 0].sum())
    return Motion(R, p, paths), finite
