"""Kinematics and inverse dynamics of a tree of revolute joints for many samples at once, compiled.

The numbers are Pinocchio's (the tests hold them to 1e-12); what is saved is a call into another language for every
sample. The samples are the last axis of every array, and eight of them are one value of `lanes`. Every joint frame is
turned here so that its joint turns about z. Whatever is fixed to a link is brought into that frame once, with
`BatchModel.attach`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from dyngrasp.lanes import LANES, cosine_sine, lanes_of, load, store
from dyngrasp.models.newton_euler import newton_euler, wrench_along
from dyngrasp.signals import Array, read_only

_AXES = {"JointModelRX": (1.0, 0.0, 0.0), "JointModelRY": (0.0, 1.0, 0.0), "JointModelRZ": (0.0, 0.0, 1.0)}

WORLD = -1  # the link that does not move


@dataclass(frozen=True, eq=False)
class Attachments:
    """K frames fixed to links: link (K,) index or `WORLD`, pose in the turned frame of that link."""

    links: NDArray[np.int64]
    rotations: Array
    positions: Array

    @property
    def arrays(self) -> tuple[NDArray[np.int64], Array, Array]:
        """All three, for compiled code."""
        return self.links, self.rotations, self.positions


@dataclass(frozen=True, eq=False)
class BatchModel:
    """Arrays of a tree of n revolute joints, in Pinocchio's order; make it with `from_pinocchio`.

    Attributes:
        parents: (n,) link that carries each joint, `WORLD` for the root.
        rotations, offsets: (n, 3, 3), (n, 3) joint frame in its parent's at q = 0.
        turns: (n, 3, 3) turned joint frame in Pinocchio's.
        mass: (n,) of the link behind each joint (kg).
        first_moment: (n, 3) mass times centre of mass in the joint frame (kg m).
        inertia: (n, 3, 3) about the joint's origin (kg m²).
        armature: (n,) kg m².
        gravity: (3,) m/s².
    """

    parents: NDArray[np.int64]
    rotations: Array
    offsets: Array
    turns: Array
    mass: Array
    first_moment: Array
    inertia: Array
    armature: Array
    gravity: Array

    @classmethod
    def from_pinocchio(cls, model: pin.Model) -> BatchModel:
        """Read a model whose joints are all revolute."""
        turns = [_z_onto(_axis(joint)) for joint in list(model.joints)[1:]]
        placements = list(model.jointPlacements)[1:]
        parents = np.array([int(parent) - 1 for parent in list(model.parents)[1:]], dtype=np.int64)
        inertias = [
            pin.SE3(turn.T, np.zeros(3)).act(inertia)
            for turn, inertia in zip(turns, list(model.inertias)[1:], strict=True)
        ]
        before = [np.eye(3) if parent == WORLD else turns[parent] for parent in parents]
        rows = zip(before, placements, turns, strict=True)
        parents.setflags(write=False)
        return cls(
            parents=parents,
            rotations=read_only([b.T @ placement.rotation @ turn for b, placement, turn in rows]),
            offsets=read_only([b.T @ p.translation for b, p in zip(before, placements, strict=True)]),
            turns=read_only(turns),
            mass=read_only([inertia.mass for inertia in inertias]),
            first_moment=read_only([inertia.mass * inertia.lever for inertia in inertias]),
            inertia=read_only([inertia.matrix()[3:, 3:] for inertia in inertias]),
            armature=read_only(model.armature),
            gravity=read_only(model.gravity.linear),
        )

    @property
    def tree(self) -> tuple[NDArray[np.int64], Array, Array]:
        """What `link_poses` and `frame_poses` take."""
        return self.parents, self.rotations, self.offsets

    @property
    def chain(self) -> tuple[Array, ...]:
        """What `newton_euler` takes: of a tree that is a chain."""
        return (
            self.rotations, self.offsets, self.mass, self.first_moment, self.inertia, self.armature, self.gravity
        )  # fmt: skip

    def attach(self, frames: list[tuple[int, pin.SE3]]) -> Attachments:
        """Frames given as (index of the joint in Pinocchio's model, 0 for the world; pose in its joint frame)."""
        links = np.array([joint - 1 for joint, _ in frames], dtype=np.int64)
        turns = [np.eye(3) if link == WORLD else self.turns[link] for link in links]
        links.setflags(write=False)
        return Attachments(
            links,
            read_only([turn.T @ T.rotation for turn, (_, T) in zip(turns, frames, strict=True)]),
            read_only([turn.T @ T.translation for turn, (_, T) in zip(turns, frames, strict=True)]),
        )

    def poses(self, q: Array, frames: Attachments) -> tuple[Array, Array]:
        """Poses of K frames in the world: rotations (K, 3, 3, M), positions (K, 3, M) for q (n, M)."""
        return frame_poses(q, self.tree, frames.arrays)

    def inverse_dynamics(self, q: Array, w: Array, v: Array) -> tuple[Array, Array]:
        """Recursive Newton-Euler for a chain (each joint on the link before it); q, w, v (n, M).

        Returns:
            Torques (n, M) with gravity and armature (Nm), and the motion of the last link in its turned frame, (9, M):
            angular velocity, angular acceleration, and acceleration of the joint's origin less gravity (m/s²).
        """
        nothing = 0.0, np.zeros(3), np.zeros((3, 3))
        return newton_euler(q, w, v, self.chain, nothing, np.zeros(q.shape[1]))


def wrench_on(body: pin.Inertia, motion: Array) -> Array:
    """Force and moment about the origin that move a body, (6, M), in the frame that `motion` (9, M) is given in.

    Args:
        body: Inertia in that frame.
        motion: As `BatchModel.inverse_dynamics` returns it; gravity is therefore in the force.
    """
    return wrench_along(motion, body.mass, body.mass * body.lever, np.ascontiguousarray(body.matrix()[3:, 3:]))


def _axis(joint: pin.JointModel) -> Array:
    name = joint.shortname()
    if name in _AXES:
        return np.array(_AXES[name])
    if name == "JointModelRevoluteUnaligned":
        return np.asarray(joint.extract().axis, dtype=float)
    raise ValueError(f"revolute joints only, got {name}")


def _z_onto(axis: Array) -> Array:
    """A rotation whose z column is `axis`; the identity for z itself."""
    return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix()


@njit(cache=True)
def side_by_side(q, q_h, arm_indices, hand_indices):
    """Configurations (n + m, M) of a tree for arm (n, M) and gripper (m, M) positions, by where their joints are."""
    both = np.empty((arm_indices.size + hand_indices.size, q.shape[1]))
    for i in range(arm_indices.size):
        both[arm_indices[i]] = q[i]
    for i in range(hand_indices.size):
        both[hand_indices[i]] = q_h[i]
    return both


@njit(cache=True, error_model="numpy")
def link_poses(q, tree, R, p):
    """Write the poses of all turned joint frames at q (n, M) of a `tree`: R (n, 3, 3, M), p (n, 3, M) in the world."""
    (n, samples), out_R, out_p = q.shape, R.reshape(-1), p.reshape(-1)
    poses = np.empty(n * _POSE)
    for begin in range(0, samples, LANES):
        _place_links(q.reshape(-1), begin, samples, tree, poses)
        for row in range(3 * n):
            _write_row(_row_of(poses, row), out_R, out_p, row, begin, samples)


@njit(cache=True, error_model="numpy")
def frame_poses(q, tree, frames):
    """`BatchModel.poses` for its `tree` and the arrays of frames."""
    (n, samples), (links, turns, shifts) = q.shape, frames
    R, p, poses = np.empty((links.size, 3, 3, samples)), np.empty((links.size, 3, samples)), np.empty(n * _POSE)
    out_R, out_p = R.reshape(-1), p.reshape(-1)
    for begin in range(0, samples, LANES):
        _place_links(q.reshape(-1), begin, samples, tree, poses)
        for f in range(links.size):
            parent = _pose_of(poses, links[f])
            for a in range(3):
                row = _compose_row(parent[a], turns[f], shifts[f])
                _write_row(row, out_R, out_p, 3 * f + a, begin, samples)
    return R, p


# Numbers of a pose [R | p] at as many samples as there are lanes, by rows.
_POSE = 12 * LANES


@njit(cache=True, error_model="numpy")
def _place_links(q, begin, samples, tree, poses):
    """Write the poses of all links at as many samples from `begin` on as there are lanes."""
    parents, rotations, offsets = tree
    for i in range(parents.size):
        c, d = cosine_sine(load(q, i * samples + begin, samples - begin))
        parent = _pose_of(poses, parents[i])
        for a in range(3):
            x, y, z, origin = _compose_row(parent[a], rotations[i], offsets[i])
            at = i * _POSE + 4 * a * LANES
            store(c * x + d * y, poses, at, LANES)
            store(c * y - d * x, poses, at + LANES, LANES)
            store(z, poses, at + 2 * LANES, LANES)
            store(origin, poses, at + 3 * LANES, LANES)


@njit(cache=True, error_model="numpy", inline="always")
def _pose_of(poses, link):
    """Three rows of the pose of a link; that of the world for `WORLD`."""
    one, zero = lanes_of(1.0), lanes_of(0.0)
    rows = (one, zero, zero, zero), (zero, one, zero, zero), (zero, zero, one, zero)
    if link >= 0:
        rows = _row_of(poses, 3 * link), _row_of(poses, 3 * link + 1), _row_of(poses, 3 * link + 2)
    return rows


@njit(cache=True, error_model="numpy", inline="always")
def _row_of(poses, row):
    at = 4 * row * LANES
    return (
        load(poses, at, LANES),
        load(poses, at + LANES, LANES),
        load(poses, at + 2 * LANES, LANES),
        load(poses, at + 3 * LANES, LANES),
    )


@njit(cache=True, error_model="numpy", inline="always")
def _write_row(row, R, p, at, begin, samples):
    """Write a row of a pose to rotations (3, M) and positions (M,) of flat arrays, from sample `begin` on."""
    room = samples - begin
    for b in range(3):
        store(row[b], R, (3 * at + b) * samples + begin, room)
    store(row[3], p, at * samples + begin, room)


@njit(cache=True, error_model="numpy", inline="always")
def _compose_row(row, turn, shift):
    """A row [x y z | origin] of a pose, times a fixed pose."""
    x, y, z, origin = row
    return (
        x * turn[0, 0] + y * turn[1, 0] + z * turn[2, 0],
        x * turn[0, 1] + y * turn[1, 1] + z * turn[2, 1],
        x * turn[0, 2] + y * turn[1, 2] + z * turn[2, 2],
        origin + x * shift[0] + y * shift[1] + z * shift[2],
    )


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def compose(R, p, turn, shift, out_R, out_p):
    """(R, p) · (turn, shift) for samples of R (3, 3, M), p (3, M) and one fixed pose."""
    for a in range(3):
        x, y, z, origin = R[a, 0], R[a, 1], R[a, 2], p[a]
        out = out_p[a]
        for s in range(out.size):
            out[s] = origin[s] + x[s] * shift[0] + y[s] * shift[1] + z[s] * shift[2]
        for b in range(3):
            out = out_R[a, b]
            for s in range(out.size):
                out[s] = x[s] * turn[0, b] + y[s] * turn[1, b] + z[s] * turn[2, b]
