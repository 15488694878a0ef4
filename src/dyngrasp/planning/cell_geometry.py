"""Arm, gripper, part and ground as collision bodies, and exact distances between them (Coal)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import trimesh
from numba import njit

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.batch_dynamics import BatchModel, compose, link_poses, side_by_side
from dyngrasp.models.bounding_volumes import bounding_bodies, boxes_around
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.models.link_motion import Motion, follow, seen_from
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import PartMotion, part_poses
from dyngrasp.planning.plan_samples import Waypoints
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
        reaches: How far each extends from the middle of its link (m).
        first_piece, ground: Numbers of bodies.
        bodies: Volumes around those of arm and hand.
        pieces: Volumes around the pieces of the part.
        middles: (F, 3) middle of the volume around each link, in its frame.
        link_pairs: (Q, 2) links whose bodies could meet.
        is_pad: (B,) bodies of the hand that touch the part when it is taken.
        on_arm: (B,) bodies of the arm and its base.
        T_flange_part: How the part hangs.
    """

    def __init__(self, task: GraspTask, grasp: Grasp) -> None:
        self.assembly: Assembly = assemble(task.robot, task.gripper)
        model, geometry = self.assembly.pin_model, self.assembly.geometry
        self._tree = BatchModel.from_pinocchio(model)
        self._indices = self.assembly.arm_indices, self.assembly.hand_indices
        bodies = list(geometry.geometryObjects)
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
        self.placements = [
            self._turned(joint, pin.SE3(body.placement)) for joint, body in zip(on_links, bodies, strict=True)
        ]
        self._identity = coal.Transform3s()
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
        links = np.array(self.links[:count], dtype=np.int64)
        links.setflags(write=False)
        bodies = bounding_bodies(self.shapes[:count], self.placements, links, assembly.pin_model.njoints)
        pieces = boxes_around(self._points, count)
        self.bodies, self.pieces = bodies, pieces
        self.reaches = [*bodies.reaches.tolist(), *pieces.reaches.tolist(), 0.0]
        self.middles = read_only([*bodies.link_ends.mean(axis=1), pieces.around.mean(axis=0)])
        self._placed = [coal.Transform3s(T.rotation, T.translation) for T in self.placements]
        # The hand counts as the last link; what is fewer joints apart touches by construction or cannot meet.
        number = np.minimum(np.arange(assembly.pin_model.njoints), n)
        pairs = np.argwhere(number[None, :] - number[:, None] >= APART)
        self.link_pairs = pairs[np.isin(pairs, links).all(axis=1)].astype(np.int64)
        self.is_pad = np.array([name in pads for name in self.names[:count]])
        self.on_arm = ~on_hand
        flange = assembly.pin_model.frames[assembly.flange_id]
        hanging = self._turned(int(flange.parentJoint), pin.SE3(flange.placement) * self.T_flange_part)
        self._hanging = int(flange.parentJoint), read_only(hanging.rotation), read_only(hanging.translation)

    def motions(self, waypoints: Waypoints, part: PartMotion) -> tuple[Motion, Motion, bool]:
        """How all links move, seen from the world and from the part, and whether all of that is finite.

        Args:
            waypoints: Samples of a plan.
            part: Where the part is until it is lifted.
        """
        return _motions(
            waypoints.q, waypoints.q_h, waypoints.times, waypoints.lifted, self._indices, self._tree.tree,
            self._hanging, self.middles, part,
        )  # fmt: skip

    def distance(self, i: int, j: int, R: Array, p: Array, k: int) -> float:
        """Exact distance of two bodies (m) at sample k of links (F, 3, 3, S), (F, 3, S) in the world."""
        self.result.clear()
        return coal.distance(
            self.shapes[i], self._at(i, R, p, k), self.shapes[j], self._at(j, R, p, k), self.request, self.result
        )

    def _at(self, i: int, R: Array, p: Array, k: int) -> coal.Transform3s:
        link = self.links[i]
        if link == WORLD and not 0 <= i < self.first_piece:
            return self._identity
        T = coal.Transform3s(R[link, :, :, k], p[link, :, k])
        return T if i >= self.first_piece else T * self._placed[i]


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
def _motions(q, q_h, times, lifted, indices, tree, hanging, middles, part):
    """See `CellGeometry.motions`."""
    arm_indices, hand_indices = indices
    both = side_by_side(q, q_h, arm_indices, hand_indices)
    R, p = np.empty((middles.shape[0], 3, 3, times.size)), np.empty((middles.shape[0], 3, times.size))
    R[WORLD], p[WORLD] = 0.0, 0.0
    for a in range(3):
        R[WORLD, a, a] = 1.0
    link_poses(both, tree, R[1:-1], p[1:-1])
    # The part stands at the first samples, then it is fixed to a link.
    carrier, turn, shift = hanging
    compose(R[carrier], p[carrier], turn, shift, R[-1], p[-1])
    part_poses(part, times[:lifted], R[-1], p[-1])
    seen_R, seen_p = seen_from(R[-1], p[-1], R, p)
    world, seen = follow(R, p, middles), follow(seen_R, seen_p, middles)
    # Comparisons would lose a NaN on the way to the least distance; the paths are sums over all of them.
    covered = world.shift[:, -1].sum() + world.turn[:, -1].sum()
    return world, seen, np.isfinite(covered + times.sum() + p[:, :, 0].sum())
