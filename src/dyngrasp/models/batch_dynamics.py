"""Kinematics and inverse dynamics of a tree of revolute joints for many samples at once, compiled.

The numbers are Pinocchio's (the tests hold them to 1e-12); what is saved is a call into another language for every
sample. Every joint frame is turned here so that its joint turns about z. Whatever is fixed to a link is brought
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
        """Poses of K frames in the world: rotations (M, K, 3, 3), positions (M, K, 3) for q (M, n)."""
        return _poses(
            np.cos(q), np.sin(q), self.parents, self.rotations, self.offsets,
            frames.links, frames.rotations, frames.positions,
        )  # fmt: skip

    def inverse_dynamics(self, q: Array, w: Array, v: Array) -> tuple[Array, Array]:
        """Recursive Newton-Euler for a chain (each joint on the link before it); q, w, v (M, n).

        Returns:
            Torques (M, n) with gravity and armature (Nm), and the motion of the last link in its turned frame, (M, 9):
            angular velocity, angular acceleration, and acceleration of the joint's origin less gravity (m/s²).
        """
        return _newton_euler(
            np.cos(q), np.sin(q), w, v, self.rotations, self.offsets,
            self.mass, self.first_moment, self.inertia, self.armature, self.gravity,
        )  # fmt: skip


def wrench_on(body: pin.Inertia, motion: Array) -> Array:
    """Force and moment about the origin that move a body, (M, 6), in the frame that `motion` (M, 9) is given in.

    Args:
        body: Inertia in that frame.
        motion: As `BatchModel.inverse_dynamics` returns it; gravity is therefore in the force.
    """
    return _wrenches(motion, body.mass, body.mass * body.lever, body.matrix()[3:, 3:])


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


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _poses(cosine, sine, parents, rotations, offsets, links, link_rotations, link_positions):
    samples, n = cosine.shape
    frames = links.size
    R, p = np.empty((n, 3, 3)), np.empty((n, 3))
    out_R, out_p = np.empty((samples, frames, 3, 3)), np.empty((samples, frames, 3))
    for s in range(samples):
        for i in range(n):
            parent = parents[i]
            c, d = cosine[s, i], sine[s, i]
            for a in range(3):
                if parent < 0:
                    x, y, z = rotations[i, a, 0], rotations[i, a, 1], rotations[i, a, 2]
                    p[i, a] = offsets[i, a]
                else:
                    u0, u1, u2 = R[parent, a, 0], R[parent, a, 1], R[parent, a, 2]
                    x = u0 * rotations[i, 0, 0] + u1 * rotations[i, 1, 0] + u2 * rotations[i, 2, 0]
                    y = u0 * rotations[i, 0, 1] + u1 * rotations[i, 1, 1] + u2 * rotations[i, 2, 1]
                    z = u0 * rotations[i, 0, 2] + u1 * rotations[i, 1, 2] + u2 * rotations[i, 2, 2]
                    p[i, a] = p[parent, a] + u0 * offsets[i, 0] + u1 * offsets[i, 1] + u2 * offsets[i, 2]
                R[i, a, 0], R[i, a, 1], R[i, a, 2] = c * x + d * y, c * y - d * x, z
        for f in range(frames):
            link = links[f]
            for a in range(3):
                if link < 0:
                    out_p[s, f, a] = link_positions[f, a]
                    for b in range(3):
                        out_R[s, f, a, b] = link_rotations[f, a, b]
                else:
                    u0, u1, u2 = R[link, a, 0], R[link, a, 1], R[link, a, 2]
                    t = link_positions[f]
                    out_p[s, f, a] = p[link, a] + u0 * t[0] + u1 * t[1] + u2 * t[2]
                    for b in range(3):
                        T = link_rotations[f]
                        out_R[s, f, a, b] = u0 * T[0, b] + u1 * T[1, b] + u2 * T[2, b]
    return out_R, out_p


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _newton(mass, h, inertia, ox, oy, oz, lx, ly, lz, ax, ay, az):
    """Force and moment about the origin for angular velocity o, angular acceleration l, acceleration a.

    f = m a + l × h + o × (o × h) and n = I l + o × I o + h × a with h = mass times centre of mass.
    """
    ux, uy, uz = oy * h[2] - oz * h[1], oz * h[0] - ox * h[2], ox * h[1] - oy * h[0]
    fx = mass * ax + ly * h[2] - lz * h[1] + oy * uz - oz * uy
    fy = mass * ay + lz * h[0] - lx * h[2] + oz * ux - ox * uz
    fz = mass * az + lx * h[1] - ly * h[0] + ox * uy - oy * ux
    jx = inertia[0, 0] * ox + inertia[0, 1] * oy + inertia[0, 2] * oz
    jy = inertia[1, 0] * ox + inertia[1, 1] * oy + inertia[1, 2] * oz
    jz = inertia[2, 0] * ox + inertia[2, 1] * oy + inertia[2, 2] * oz
    nx = inertia[0, 0] * lx + inertia[0, 1] * ly + inertia[0, 2] * lz + oy * jz - oz * jy + h[1] * az - h[2] * ay
    ny = inertia[1, 0] * lx + inertia[1, 1] * ly + inertia[1, 2] * lz + oz * jx - ox * jz + h[2] * ax - h[0] * az
    nz = inertia[2, 0] * lx + inertia[2, 1] * ly + inertia[2, 2] * lz + ox * jy - oy * jx + h[0] * ay - h[1] * ax
    return fx, fy, fz, nx, ny, nz


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _newton_euler(cosine, sine, w, v, rotations, offsets, mass, first_moment, inertia, armature, gravity):
    samples, n = cosine.shape
    R, force = np.empty((n, 3, 3)), np.empty((n, 6))
    torque, tip = np.empty((samples, n)), np.empty((samples, 9))
    for s in range(samples):
        ox = oy = oz = lx = ly = lz = 0.0
        # Lifting the base with −g stands for gravity on every link.
        ax, ay, az = -gravity[0], -gravity[1], -gravity[2]
        for i in range(n):
            c, d = cosine[s, i], sine[s, i]
            E = R[i]
            for a in range(3):
                x, y = rotations[i, a, 0], rotations[i, a, 1]
                E[a, 0], E[a, 1], E[a, 2] = c * x + d * y, c * y - d * x, rotations[i, a, 2]
            # a + l × r + o × (o × r), the acceleration of this joint's origin in the parent's frame
            rx, ry, rz = offsets[i, 0], offsets[i, 1], offsets[i, 2]
            ux, uy, uz = oy * rz - oz * ry, oz * rx - ox * rz, ox * ry - oy * rx
            bx = ax + ly * rz - lz * ry + oy * uz - oz * uy
            by = ay + lz * rx - lx * rz + oz * ux - ox * uz
            bz = az + lx * ry - ly * rx + ox * uy - oy * ux
            ax = E[0, 0] * bx + E[1, 0] * by + E[2, 0] * bz
            ay = E[0, 1] * bx + E[1, 1] * by + E[2, 1] * bz
            az = E[0, 2] * bx + E[1, 2] * by + E[2, 2] * bz
            tx = E[0, 0] * ox + E[1, 0] * oy + E[2, 0] * oz
            ty = E[0, 1] * ox + E[1, 1] * oy + E[2, 1] * oz
            tz = E[0, 2] * ox + E[1, 2] * oy + E[2, 2] * oz
            rate = w[s, i]
            mx = E[0, 0] * lx + E[1, 0] * ly + E[2, 0] * lz
            my = E[0, 1] * lx + E[1, 1] * ly + E[2, 1] * lz
            mz = E[0, 2] * lx + E[1, 2] * ly + E[2, 2] * lz
            lx, ly, lz = mx + ty * rate, my - tx * rate, mz + v[s, i]
            ox, oy, oz = tx, ty, tz + rate
            f = _newton(mass[i], first_moment[i], inertia[i], ox, oy, oz, lx, ly, lz, ax, ay, az)
            for a in range(6):
                force[i, a] = f[a]
        tip[s, 0], tip[s, 1], tip[s, 2] = ox, oy, oz
        tip[s, 3], tip[s, 4], tip[s, 5] = lx, ly, lz
        tip[s, 6], tip[s, 7], tip[s, 8] = ax, ay, az
        for i in range(n - 1, -1, -1):
            torque[s, i] = force[i, 5] + armature[i] * v[s, i]
            if i > 0:
                E, g = R[i], force[i]
                fx = E[0, 0] * g[0] + E[0, 1] * g[1] + E[0, 2] * g[2]
                fy = E[1, 0] * g[0] + E[1, 1] * g[1] + E[1, 2] * g[2]
                fz = E[2, 0] * g[0] + E[2, 1] * g[1] + E[2, 2] * g[2]
                rx, ry, rz = offsets[i, 0], offsets[i, 1], offsets[i, 2]
                below = force[i - 1]
                below[0] += fx
                below[1] += fy
                below[2] += fz
                below[3] += E[0, 0] * g[3] + E[0, 1] * g[4] + E[0, 2] * g[5] + ry * fz - rz * fy
                below[4] += E[1, 0] * g[3] + E[1, 1] * g[4] + E[1, 2] * g[5] + rz * fx - rx * fz
                below[5] += E[2, 0] * g[3] + E[2, 1] * g[4] + E[2, 2] * g[5] + rx * fy - ry * fx
    return torque, tip


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _wrenches(motion, mass, first_moment, inertia):
    out = np.empty((motion.shape[0], 6))
    for s in range(motion.shape[0]):
        m = motion[s]
        f = _newton(mass, first_moment, inertia, m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8])
        for a in range(6):
            out[s, a] = f[a]
    return out
