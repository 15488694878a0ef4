"""Distances between the moving bodies, the part and the ground along a plan, from their collision geometry (Coal)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import coal
import numpy as np
import pinocchio as pin
import trimesh

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import AuditEntry
from dyngrasp.signals import Array

# Pairs whose bounding spheres are farther apart than this (m) are not measured: the audit asks for contact, not for
# the exact width of a gap that nobody would call narrow.
HORIZON = 0.10

# The hand moves at most this far (rad of any joint) between two samples: about a centimetre at the finger tips.
JOINT_STEP = 0.015

# The part stands on the ground when it is lifted; its own pieces may reach this far below z = 0 by rounding (m).
RESTING_TOLERANCE = 5e-4

GROUND = "ground"


@dataclass(frozen=True)
class _Pair:
    """Two bodies to keep apart, by index into the geometry model."""

    first: int
    second: int
    name: str


class CellGeometry:
    """Arm, gripper, part and ground as collision bodies; the part stands in the world or hangs in the gripper.

    Args:
        task: Arm, gripper and part.
        grasp: How the part hangs in the gripper once it is taken.
    """

    def __init__(self, task: GraspTask, grasp: Grasp) -> None:
        self.assembly: Assembly = assemble(task.robot, task.gripper)
        self.model = self.assembly.pin_model
        self.data = self.model.createData()
        self.geometry = pin.GeometryModel(self.assembly.geometry)
        self.moving = [self.geometry.getGeometryId(n) for n in self.assembly.arm_geoms + self.assembly.hand_geoms]
        self.pads = {self.geometry.getGeometryId(name) for name in self.assembly.pad_geoms}
        self.hand = {self.geometry.getGeometryId(name) for name in self.assembly.hand_geoms}
        self.pieces = [self._add_piece(path) for path in task.grasp_object.piece_paths]
        self.ground = self.geometry.addGeometryObject(
            pin.GeometryObject(GROUND, 0, pin.SE3.Identity(), coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0))
        )
        self.placements = pin.GeometryData(self.geometry)
        T_flange_grasp = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(task.closed_posture(grasp))
        self.T_flange_object = T_flange_grasp * grasp.T_object_grasp.inverse()
        self.spheres = [self._bounding_sphere(body) for body in self.geometry.geometryObjects]
        self._centres = np.zeros((len(self.spheres), 3))
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()

    def _add_piece(self, path) -> int:
        hull = trimesh.load_mesh(path).convex_hull
        points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for vertex in hull.vertices:
            points.append(np.asarray(vertex))
        for face in hull.faces:
            faces.append(coal.Triangle(*(int(i) for i in face)))
        piece = pin.GeometryObject(path.stem, 0, pin.SE3.Identity(), coal.Convex(points, faces))
        return self.geometry.addGeometryObject(piece)

    @staticmethod
    def _bounding_sphere(body: pin.GeometryObject) -> tuple[Array, float]:
        """Centre in the body's own frame (m) and radius (m) of a sphere around it."""
        if isinstance(body.geometry, coal.Halfspace):
            return np.zeros(3), np.inf
        body.geometry.computeLocalAABB()
        return np.array(body.geometry.aabb_center), float(body.geometry.aabb_radius)

    def place(self, q: Array, q_h: Array, T_world_object: pin.SE3) -> None:
        """Move arm and hand to one configuration and the part to a pose."""
        configuration = self.assembly.configuration(q, q_h)
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.placements, configuration)
        self.place_part(T_world_object)

    def place_part(self, T_world_object: pin.SE3) -> None:
        """Move the part alone."""
        for piece in self.pieces:
            self.placements.oMg[piece] = T_world_object
        self._centres = np.array([self.placements.oMg[i].act(c) for i, (c, _) in enumerate(self.spheres)])

    def nearest(self, pairs: Iterable[_Pair]) -> tuple[float, str]:
        """Smallest distance (m, negative for penetration) among `pairs` and whose it is; at most `HORIZON`."""
        best, name = HORIZON, ""
        for pair in pairs:
            if pair.second == self.ground:
                apart = self._centres[pair.first][2] - self.spheres[pair.first][1]
            else:
                apart = np.linalg.norm(self._centres[pair.first] - self._centres[pair.second])
                apart -= self.spheres[pair.first][1] + self.spheres[pair.second][1]
            if apart >= best:
                continue
            distance = self._distance(pair)
            if distance < best:
                best, name = distance, pair.name
        return best, name

    def _distance(self, pair: _Pair) -> float:
        objects, oMg = self.geometry.geometryObjects, self.placements.oMg
        first, second = oMg[pair.first], oMg[pair.second]
        self.result.clear()
        return coal.distance(
            objects[pair.first].geometry,
            coal.Transform3s(first.rotation, first.translation),
            objects[pair.second].geometry,
            coal.Transform3s(second.rotation, second.translation),
            self.request,
            self.result,
        )

    def pairs(self, first: Iterable[int], second: Iterable[int]) -> list[_Pair]:
        """All pairs of the two groups, named after both bodies."""
        names = [body.name for body in self.geometry.geometryObjects]
        second = list(second)
        return [_Pair(i, k, f"{names[i]} and {names[k]}") for i in first for k in second]

    def self_pairs(self) -> list[_Pair]:
        """Pairs of arm and hand that can meet: three or more joints apart; the hand counts as the last link."""
        n = self.assembly.robot.n
        link = {i: min(self.geometry.geometryObjects[i].parentJoint, n) for i in self.moving}
        return [pair for pair in self.pairs(self.moving, self.moving) if link[pair.second] - link[pair.first] >= 3]

    def flange(self) -> pin.SE3:
        """T_world_flange at the configuration placed last."""
        return pin.SE3(pin.updateFramePlacement(self.model, self.data, self.assembly.flange_id))


@lru_cache(maxsize=8)
def _cell(task: GraspTask, grasp_name: str) -> CellGeometry:
    return CellGeometry(task, next(g for g in task.grasp_object.grasps if g.name == grasp_name))


def clearance_entries(
    task: GraspTask, targets: GraspTargets, motion: dict[str, tuple[Array, Array, Array]]
) -> list[AuditEntry]:
    """Least distances along a plan: to the ground, to the part outside the intended contact, of the arm to itself.

    Args:
        task: Arm, gripper and part.
        targets: Where the part stands and how it is taken.
        motion: For each phase its times (M,) on the plan's clock, arm (M, n) and gripper (M, m) positions.

    Returns:
        Entries "ground_clearance", "part_clearance", "self_clearance" and, for the carried part against ground and
        arm, "carried_clearance"; distances above `HORIZON` are reported as `HORIZON`.
    """
    cell = _cell(task, targets.grasp.name)
    arm = [i for i in cell.moving if i not in cell.hand and cell.geometry.geometryObjects[i].parentJoint > 0]
    moving = arm + sorted(cell.hand)
    may_not_touch = sorted(cell.hand - cell.pads)
    standing = {
        "ground_clearance": cell.pairs(moving, [cell.ground]),
        "part_clearance": cell.pairs(moving, cell.pieces),
        "self_clearance": cell.self_pairs(),
    }
    closing = standing | {"part_clearance": cell.pairs(arm + may_not_touch, cell.pieces)}
    base = [i for i in cell.moving if i not in moving]
    carried = closing | {"carried_clearance": cell.pairs(cell.pieces, [*base, *arm, cell.ground])}
    checks = {"approach": standing, "grasp": closing, "deliver": carried}

    worst: dict[str, tuple[float, float, str]] = {}
    for phase, (times, q, q_h) in motion.items():
        for k in _spread(q):
            cell.place(q[k], q_h[k], targets.T_world_object)
            if phase == "deliver":
                cell.place_part(cell.flange() * cell.T_flange_object)
            for name, pairs in checks[phase].items():
                distance, who = cell.nearest(pairs)
                if name not in worst or distance < worst[name][0]:
                    worst[name] = (distance, float(times[k]), who)
    tolerance = {"carried_clearance": RESTING_TOLERANCE}
    return [
        AuditEntry(name, distance, 0.0, True, tolerance.get(name, 0.0), "m", time, who)
        for name, (distance, time, who) in worst.items()
    ]


def _spread(q: Array) -> list[int]:
    """Indices of samples of q (M, n), first and last included, at most `JOINT_STEP` apart where the samples allow it."""
    chosen = [0]
    for k in range(1, len(q)):
        is_last = k == len(q) - 1
        if is_last or np.abs(q[k + 1] - q[chosen[-1]]).max() > JOINT_STEP:
            chosen.append(k)
    return chosen
