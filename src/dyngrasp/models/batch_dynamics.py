"""Kinematics and inverse dynamics of a tree of revolute joints for many samples at once, compiled.

The numbers are Pinocchio's (the tests hold them to 1e-12); what is saved is a call into another language for every
sample. The samples are the last axis of every array: a loop over them is one that the compiler turns into vector
instructions. Every joint frame is turned here so that its joint turns about z. Whatever is fixed to a link is brought
into that frame once, with `BatchModel.attach`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

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
        return newton_euler(q, w, v, self.chain)


def wrench_on(body: pin.Inertia, motion: Array) -> Array:
    """Force and moment about the origin that move a body, (6, M), in the frame that `motion` (9, M) is given in.

    Args:
        body: Inertia in that frame.
        motion: As `BatchModel.inverse_dynamics` returns it; gravity is therefore in the force.
    """
    return _wrench(motion, body.mass, body.mass * body.lever, np.ascontiguousarray(body.matrix()[3:, 3:]))


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


# π/2 in three parts, the first two of 33 bits: multiples below 2^20 are subtracted without rounding (Cody and Waite).
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)

# Minimax polynomials of (sin r − r) / r³ and (cos r − 1 + r²/2) / r⁴ in r² for |r| ≤ π/4, those of fdlibm.
_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def cosine_sine(angles):
    """Cosines and sines (n, M) of angles (n, M) below 10⁶ rad, to 2 ulp of 1; without branches, unlike libm's."""
    cosine, sine = np.empty(angles.shape), np.empty(angles.shape)
    for i in range(angles.shape[0]):
        for s in range(angles.shape[1]):
            x = angles[i, s]
            quarter = np.floor(x / (np.pi / 2) + 0.5)
            r = ((x - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
            z = r * r
            p = _SINE[4] + z * _SINE[5]
            p = _SINE[0] + z * (_SINE[1] + z * (_SINE[2] + z * (_SINE[3] + z * p)))
            g = _COSINE[4] + z * _COSINE[5]
            g = _COSINE[0] + z * (_COSINE[1] + z * (_COSINE[2] + z * (_COSINE[3] + z * g)))
            near_sine, near_cosine = r + r * z * p, 1.0 - 0.5 * z + z * z * g
            # Each quarter turn exchanges the two; the signs are + + − − for the sine, + − − + for the cosine.
            odd = quarter - 2.0 * np.floor(quarter / 2.0)
            sign = 1.0 - 2.0 * (np.floor(quarter / 2.0) - 2.0 * np.floor(quarter / 4.0))
            sine[i, s] = sign * (near_sine + odd * (near_cosine - near_sine))
            cosine[i, s] = sign * (1.0 - 2.0 * odd) * (near_cosine + odd * (near_sine - near_cosine))
    return cosine, sine


@njit(cache=True)
def side_by_side(q, q_h, arm_indices, hand_indices):
    """Configurations (n + m, M) of a tree for arm (n, M) and gripper (m, M) positions, by where their joints are."""
    both = np.empty((arm_indices.size + hand_indices.size, q.shape[1]))
    for i in range(arm_indices.size):
        both[arm_indices[i]] = q[i]
    for i in range(hand_indices.size):
        both[hand_indices[i]] = q_h[i]
    return both


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def link_poses(q, tree, R, p):
    """Write the poses of all turned joint frames at q (n, M) of a `tree`: R (n, 3, 3, M), p (n, 3, M) in the world."""
    (cosine, sine), (parents, rotations, offsets) = cosine_sine(q), tree
    n, samples = q.shape
    for i in range(n):
        fixed, offset = rotations[i], offsets[i]
        if parents[i] < 0:
            for a in range(3):
                p[i, a] = offset[a]
                for b in range(3):
                    R[i, a, b] = fixed[a, b]
        else:
            compose(R[parents[i]], p[parents[i]], fixed, offset, R[i], p[i])
        for a in range(3):
            x, y = R[i, a, 0], R[i, a, 1]
            for s in range(samples):
                x[s], y[s] = cosine[i, s] * x[s] + sine[i, s] * y[s], cosine[i, s] * y[s] - sine[i, s] * x[s]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def frame_poses(q, tree, frames):
    """`BatchModel.poses` for its `tree` and the arrays of frames."""
    (n, samples), (links, link_rotations, link_positions) = q.shape, frames
    R, p = np.empty((n, 3, 3, samples)), np.empty((n, 3, samples))
    link_poses(q, tree, R, p)
    out_R, out_p = np.empty((links.size, 3, 3, samples)), np.empty((links.size, 3, samples))
    for f in range(links.size):
        if links[f] < 0:
            for a in range(3):
                out_p[f, a] = link_positions[f, a]
                for b in range(3):
                    out_R[f, a, b] = link_rotations[f, a, b]
        else:
            compose(R[links[f]], p[links[f]], link_rotations[f], link_positions[f], out_R[f], out_p[f])
    return out_R, out_p


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


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def newton_euler(q, w, v, chain):
    """`BatchModel.inverse_dynamics` for its `chain`."""
    wrenches, motion = link_wrenches(q, w, v, chain)
    return joint_torques(q, v, wrenches, chain), motion


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def link_wrenches(q, w, v, chain):
    """Way out of the recursion, for q, q̇, q̈ (n, M) and the arrays of a `chain`.

    Returns:
        Force and moment (N, Nm) that move each link by itself, (n, 6, M), and the motion (9, M) of the last one, as of
        `BatchModel.inverse_dynamics`.
    """
    rotations, offsets, mass, first_moment, inertia, _, gravity = chain
    (n, samples), (cosine, sine) = q.shape, cosine_sine(q)
    wrenches = np.empty((n, 6, samples))
    motion, moved = np.zeros((9, samples)), np.empty((9, samples))
    # Lifting the base with −g stands for gravity on every link.
    for a in range(3):
        motion[6 + a] = -gravity[a]
    for i in range(n):
        _to_child(cosine[i], sine[i], rotations[i], offsets[i], w[i], v[i], motion, moved)
        motion, moved = moved, motion
        newton(mass[i], first_moment[i], inertia[i], motion, wrenches[i])
    return wrenches, motion


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def joint_torques(q, v, wrenches, chain):
    """Way back of the recursion: torques (n, M) (Nm) for the wrenches of `link_wrenches`, overwritten by their sums."""
    rotations, offsets, _, _, _, armature, _ = chain
    (n, samples), (cosine, sine), torque = q.shape, cosine_sine(q), np.empty(q.shape)
    for i in range(n - 1, -1, -1):
        for s in range(samples):
            torque[i, s] = wrenches[i, 5, s] + armature[i] * v[i, s]
        if i > 0:
            _to_parent(cosine[i], sine[i], rotations[i], offsets[i], wrenches[i], wrenches[i - 1])
    return torque


@njit(cache=True, inline="always")
def _turned(c, s, x, y):
    """One row of the rotation E = fixed · Rot_z of a joint, its first two elements; the third is that of `fixed`."""
    return c * x + s * y, c * y - s * x


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _to_child(cosine, sine, fixed, offset, rate, acceleration, motion, out):
    """Angular velocity o, angular acceleration l, acceleration a of the next link, each in its own frame.

    o' = Eᵀ o + z ω,  l' = Eᵀ l + Eᵀ o × z ω + z v,  a' = Eᵀ (a + l × r + o × (o × r)).
    """
    (rx, ry, rz), (fxx, fyx, zx), (fxy, fyy, zy), (fxz, fyz, zz) = offset, fixed[0], fixed[1], fixed[2]
    # Two loops: one that writes nine rows does not become vector instructions, for all might overlap.
    for s in range(rate.size):
        c, d = cosine[s], sine[s]
        (xx, yx), (xy, yy), (xz, yz) = _turned(c, d, fxx, fyx), _turned(c, d, fxy, fyy), _turned(c, d, fxz, fyz)
        ox, oy, oz, lx, ly, lz = motion[0, s], motion[1, s], motion[2, s], motion[3, s], motion[4, s], motion[5, s]
        tx, ty = xx * ox + xy * oy + xz * oz, yx * ox + yy * oy + yz * oz
        out[0, s], out[1, s], out[2, s] = tx, ty, zx * ox + zy * oy + zz * oz + rate[s]
        out[3, s] = xx * lx + xy * ly + xz * lz + ty * rate[s]
        out[4, s] = yx * lx + yy * ly + yz * lz - tx * rate[s]
        out[5, s] = zx * lx + zy * ly + zz * lz + acceleration[s]
    for s in range(rate.size):
        c, d = cosine[s], sine[s]
        (xx, yx), (xy, yy), (xz, yz) = _turned(c, d, fxx, fyx), _turned(c, d, fxy, fyy), _turned(c, d, fxz, fyz)
        ox, oy, oz, lx, ly, lz = motion[0, s], motion[1, s], motion[2, s], motion[3, s], motion[4, s], motion[5, s]
        ux, uy, uz = oy * rz - oz * ry, oz * rx - ox * rz, ox * ry - oy * rx
        ax = motion[6, s] + ly * rz - lz * ry + oy * uz - oz * uy
        ay = motion[7, s] + lz * rx - lx * rz + oz * ux - ox * uz
        az = motion[8, s] + lx * ry - ly * rx + ox * uy - oy * ux
        out[6, s], out[7, s] = xx * ax + xy * ay + xz * az, yx * ax + yy * ay + yz * az
        out[8, s] = zx * ax + zy * ay + zz * az


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def newton(mass, h, inertia, motion, out):
    """Force and moment about the origin, for the motion (o, l, a) of a link with h = mass times centre of mass.

    f = m a + l × h + o × (o × h),  n = I l + o × I o + h × a.
    """
    hx, hy, hz = h
    xx, xy, xz, yy, yz, zz = inertia[0, 0], inertia[0, 1], inertia[0, 2], inertia[1, 1], inertia[1, 2], inertia[2, 2]
    for s in range(motion.shape[1]):
        ox, oy, oz, lx, ly, lz = motion[0, s], motion[1, s], motion[2, s], motion[3, s], motion[4, s], motion[5, s]
        ax, ay, az = motion[6, s], motion[7, s], motion[8, s]
        ux, uy, uz = oy * hz - oz * hy, oz * hx - ox * hz, ox * hy - oy * hx
        out[0, s] = mass * ax + ly * hz - lz * hy + oy * uz - oz * uy
        out[1, s] = mass * ay + lz * hx - lx * hz + oz * ux - ox * uz
        out[2, s] = mass * az + lx * hy - ly * hx + ox * uy - oy * ux
        jx, jy, jz = xx * ox + xy * oy + xz * oz, xy * ox + yy * oy + yz * oz, xz * ox + yz * oy + zz * oz
        out[3, s] = xx * lx + xy * ly + xz * lz + oy * jz - oz * jy + hy * az - hz * ay
        out[4, s] = xy * lx + yy * ly + yz * lz + oz * jx - ox * jz + hz * ax - hx * az
        out[5, s] = xz * lx + yz * ly + zz * lz + ox * jy - oy * jx + hx * ay - hy * ax


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _to_parent(cosine, sine, fixed, offset, wrench, out):
    """Add a wrench about a joint's origin to that about its parent's: f += E f', n += E n' + r × E f'."""
    (rx, ry, rz), (fxx, fyx, zx), (fxy, fyy, zy), (fxz, fyz, zz) = offset, fixed[0], fixed[1], fixed[2]
    for s in range(cosine.size):
        c, d = cosine[s], sine[s]
        (xx, yx), (xy, yy), (xz, yz) = _turned(c, d, fxx, fyx), _turned(c, d, fxy, fyy), _turned(c, d, fxz, fyz)
        gx, gy, gz, mx, my, mz = wrench[0, s], wrench[1, s], wrench[2, s], wrench[3, s], wrench[4, s], wrench[5, s]
        fx, fy, fz = xx * gx + yx * gy + zx * gz, xy * gx + yy * gy + zy * gz, xz * gx + yz * gy + zz * gz
        out[0, s] += fx
        out[1, s] += fy
        out[2, s] += fz
        out[3, s] += xx * mx + yx * my + zx * mz + ry * fz - rz * fy
        out[4, s] += xy * mx + yy * my + zy * mz + rz * fx - rx * fz
        out[5, s] += xz * mx + yz * my + zz * mz + rx * fy - ry * fx


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _wrench(motion, mass, first_moment, inertia):
    out = np.empty((6, motion.shape[1]))
    newton(mass, first_moment, inertia, motion, out)
    return out
