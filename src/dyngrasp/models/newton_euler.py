"""Recursive Newton-Euler for a chain of revolute joints that turn about z, at many samples at once, compiled.

Vectors of a link are tuples of three `Lanes`: a step of the recursion is done at eight samples, and the chain goes
through registers. The numbers are Pinocchio's.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.lanes import LANES, cosine_sine, lanes_of, load, store


@njit(cache=True, error_model="numpy")
def newton_euler(q, w, v, chain, body, share):
    """`BatchModel.inverse_dynamics` for its `chain`, with a body fixed to the last link at some of the samples.

    Args:
        q: (n, M) rad.
        w: (n, M) rad/s.
        v: (n, M) rad/s².
        chain: Of the `BatchModel`.
        body: Mass (kg), first moment (3,) (kg m) and inertia (3, 3) (kg m²) in the turned frame of the last link.
        share: (M,) how much of it there is.

    Returns:
        As there.
    """
    (rotations, offsets, mass, first_moment, inertia, armature, gravity), (n, samples) = chain, q.shape
    torque, motion = np.empty((n, samples)), np.empty((9, samples))
    positions, rates, accelerations = q.reshape(-1), w.reshape(-1), v.reshape(-1)
    torques, last = torque.reshape(-1), motion.reshape(-1)
    # Of each link at the samples at hand: cosine and sine of its joint, and the wrench that moves it.
    turns, wrenches = np.empty(n * 2 * LANES), np.empty(n * 6 * LANES)
    rest = lanes_of(0.0), lanes_of(0.0), lanes_of(0.0)
    for begin in range(0, samples, LANES):
        room = samples - begin
        # Lifting the base with −g stands for gravity on every link.
        o, e, a = rest, rest, (lanes_of(-gravity[0]), lanes_of(-gravity[1]), lanes_of(-gravity[2]))
        for i in range(n):
            at = i * samples + begin
            c, d = cosine_sine(load(positions, at, room))
            store(c, turns, 2 * i * LANES, LANES)
            store(d, turns, (2 * i + 1) * LANES, LANES)
            axes = _axes(c, d, rotations[i])
            o, e, a = _to_child(axes, offsets[i], load(rates, at, room), load(accelerations, at, room), o, e, a)
            f, m = _newton(mass[i], first_moment[i], inertia[i], o, e, a)
            if i == n - 1:
                held, (more_f, more_m) = load(share, begin, room), _newton(body[0], body[1], body[2], o, e, a)
                f, m = _plus(f, held, more_f), _plus(m, held, more_m)
            _write(f, wrenches, 6 * i * LANES, LANES, LANES)
            _write(m, wrenches, (6 * i + 3) * LANES, LANES, LANES)
        _write(o, last, begin, samples, room)
        _write(e, last, 3 * samples + begin, samples, room)
        _write(a, last, 6 * samples + begin, samples, room)
        f, m, one = rest, rest, lanes_of(1.0)
        for i in range(n - 1, -1, -1):
            f = _plus(_read(wrenches, 6 * i * LANES, LANES, LANES), one, f)
            m = _plus(_read(wrenches, (6 * i + 3) * LANES, LANES, LANES), one, m)
            at = i * samples + begin
            store(m[2] + armature[i] * load(accelerations, at, room), torques, at, room)
            c, d = load(turns, 2 * i * LANES, LANES), load(turns, (2 * i + 1) * LANES, LANES)
            f, m = _to_parent(_axes(c, d, rotations[i]), offsets[i], f, m)
    return torque, motion


@njit(cache=True, error_model="numpy")
def wrench_along(motion, mass, first_moment, inertia):
    """Force (N) and moment (Nm) about the origin that move a body, (6, M), for a `motion` (9, M)."""
    samples, wrench = motion.shape[1], np.empty((6, motion.shape[1]))
    rows, out = motion.reshape(-1), wrench.reshape(-1)
    for begin in range(0, samples, LANES):
        room = samples - begin
        o = _read(rows, begin, samples, room)
        e = _read(rows, 3 * samples + begin, samples, room)
        a = _read(rows, 6 * samples + begin, samples, room)
        f, m = _newton(mass, first_moment, inertia, o, e, a)
        _write(f, out, begin, samples, room)
        _write(m, out, 3 * samples + begin, samples, room)
    return wrench


@njit(cache=True, inline="always")
def _read(numbers, at, stride, room):
    """Three rows of a flat array."""
    return load(numbers, at, room), load(numbers, at + stride, room), load(numbers, at + 2 * stride, room)


@njit(cache=True, inline="always")
def _write(vector, numbers, at, stride, room):
    store(vector[0], numbers, at, room)
    store(vector[1], numbers, at + stride, room)
    store(vector[2], numbers, at + 2 * stride, room)


@njit(cache=True, inline="always")
def _plus(u, factor, v):
    return u[0] + factor * v[0], u[1] + factor * v[1], u[2] + factor * v[2]


@njit(cache=True, error_model="numpy", inline="always")
def _axes(c, d, fixed):
    """Rows of the rotation fixed · Rot_z of a joint, for cosine and sine of its angle; the third of each is fixed."""
    return (
        (c * fixed[0, 0] + d * fixed[0, 1], c * fixed[0, 1] - d * fixed[0, 0], fixed[0, 2]),
        (c * fixed[1, 0] + d * fixed[1, 1], c * fixed[1, 1] - d * fixed[1, 0], fixed[1, 2]),
        (c * fixed[2, 0] + d * fixed[2, 1], c * fixed[2, 1] - d * fixed[2, 0], fixed[2, 2]),
    )


@njit(cache=True, error_model="numpy", inline="always")
def _seen(axes, vector):
    """Eᵀ u for the rows of E."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = axes
    x, y, z = vector
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


@njit(cache=True, error_model="numpy", inline="always")
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@njit(cache=True, error_model="numpy", inline="always")
def _to_child(axes, offset, rate, acceleration, o, e, a):
    """Angular velocity o, angular acceleration e, acceleration a of the next link, each in its own frame.

    o' = Eᵀ o + z ω,  l' = Eᵀ e + Eᵀ o × z ω + z v,  a' = Eᵀ (a + e × r + o × (o × r)).
    """
    r = offset[0], offset[1], offset[2]
    p, s = _cross(e, r), _cross(o, _cross(o, r))
    (x, y, z), (ex, ey, ez) = _seen(axes, o), _seen(axes, e)
    moved = _seen(axes, (a[0] + p[0] + s[0], a[1] + p[1] + s[1], a[2] + p[2] + s[2]))
    return (x, y, z + rate), (ex + y * rate, ey - x * rate, ez + acceleration), moved


@njit(cache=True, error_model="numpy", inline="always")
def _newton(mass, first_moment, inertia, o, e, a):
    """Force and moment about the origin, for the motion (o, e, a) of a link with h = mass times centre of mass.

    f = m a + e × h + o × (o × h),  n = I e + o × I o + h × a.
    """
    h = first_moment[0], first_moment[1], first_moment[2]
    xx, xy, xz, yy, yz, zz = inertia[0, 0], inertia[0, 1], inertia[0, 2], inertia[1, 1], inertia[1, 2], inertia[2, 2]
    spin = xx * o[0] + xy * o[1] + xz * o[2], xy * o[0] + yy * o[1] + yz * o[2], xz * o[0] + yz * o[1] + zz * o[2]
    p, s, g, t = _cross(e, h), _cross(o, _cross(o, h)), _cross(o, spin), _cross(h, a)
    return (mass * a[0] + p[0] + s[0], mass * a[1] + p[1] + s[1], mass * a[2] + p[2] + s[2]), (
        xx * e[0] + xy * e[1] + xz * e[2] + g[0] + t[0],
        xy * e[0] + yy * e[1] + yz * e[2] + g[1] + t[1],
        xz * e[0] + yz * e[1] + zz * e[2] + g[2] + t[2],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _to_parent(axes, offset, f, m):
    """A wrench about a joint's origin as one about its parent's: f = E f', n = E n' + r × E f'."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = axes
    r = offset[0], offset[1], offset[2]
    turned = (
        xx * f[0] + yx * f[1] + zx * f[2],
        xy * f[0] + yy * f[1] + zy * f[2],
        xz * f[0] + yz * f[1] + zz * f[2],
    )
    t = _cross(r, turned)
    return turned, (
        xx * m[0] + yx * m[1] + zx * m[2] + t[0],
        xy * m[0] + yy * m[1] + zy * m[2] + t[1],
        xz * m[0] + yz * m[1] + zz * m[2] + t[2],
    )
