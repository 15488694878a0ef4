"""The recursive Newton–Euler algorithm in CasADi, from the inertias of a Pinocchio model, for any revolute chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import pinocchio as pin

from dyngrasp.signals import Array

if TYPE_CHECKING:
    from dyngrasp.models.gripper import GripperModel
    from dyngrasp.models.robot import RobotModel

PAYLOAD_SIZE = 10
"""Length of a payload vector, `pin.Inertia.toDynamicParameters()`: m, m·c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz; c and I
belong to the flange frame, I about its origin."""

ROUNDING = 1e-15  # entries below it come from normalised quaternions; as exact zeros they drop out of the expressions


@dataclass(frozen=True)
class _Body:
    """Mass m, first moment m·c and inertia about the frame's origin, numbers or symbols."""

    m: ca.SX
    mc: ca.SX
    inertia: ca.SX

    @classmethod
    def from_parameters(cls, parameters: Array | ca.SX) -> _Body:
        m, x, y, z, xx, xy, yy, xz, yz, zz = ca.vertsplit(ca.SX(parameters))
        inertia = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        return cls(m, ca.vertcat(x, y, z), inertia)

    def wrench(self, omega: ca.SX, alpha: ca.SX, a: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Force and moment about the origin that give the body this motion; a is the acceleration of the origin."""
        force = self.m * a + ca.cross(alpha, self.mc) + ca.cross(omega, ca.cross(omega, self.mc))
        moment = self.inertia @ alpha + ca.cross(self.mc, a) + ca.cross(omega, self.inertia @ omega)
        return force, moment


def _exact(values: Array) -> ca.SX:
    return ca.SX(ca.DM(np.where(np.abs(values) < ROUNDING, 0.0, values)))


def _axis(joint: pin.JointModel) -> Array:
    return np.array(joint.createData().S).ravel()[3:]


def _rotation(axis: Array, angle: ca.SX) -> ca.SX:
    """Rodrigues' formula, in the form whose constant entries stay exact for an axis along x, y or z."""
    along = np.outer(axis, axis)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return _exact(along) + ca.cos(angle) * _exact(np.eye(3) - along) + ca.sin(angle) * _exact(cross)


def _link_pose(model: pin.Model, i: int, q_i: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Rotation and origin of link i in the link that carries it."""
    placement = model.jointPlacements[i]
    return _exact(placement.rotation) @ _rotation(_axis(model.joints[i]), q_i), _exact(placement.translation)


def _motions(robot: RobotModel, q: ca.SX, w: ca.SX, v: ca.SX) -> list[tuple[ca.SX, ca.SX, ca.SX]]:
    """ω, α and a of the origin of each link and, last, of the flange, each in its own axes; a includes −g."""
    model = robot.pin_model
    omega, alpha = ca.SX.zeros(3), ca.SX.zeros(3)
    a = -_exact(model.gravity.linear)  # gravity is an upward acceleration of the base
    motions = []
    for i in range(1, robot.n + 1):
        R, p = _link_pose(model, i, q[i - 1])
        axis = _exact(_axis(model.joints[i]))
        a = R.T @ (a + ca.cross(alpha, p) + ca.cross(omega, ca.cross(omega, p)))
        alpha = R.T @ alpha + v[i - 1] * axis + ca.cross(R.T @ omega, w[i - 1] * axis)
        omega = R.T @ omega + w[i - 1] * axis
        motions.append((omega, alpha, a))
    R, p = _exact(robot.T_last_flange.rotation), _exact(robot.T_last_flange.translation)
    a = R.T @ (a + ca.cross(alpha, p) + ca.cross(omega, ca.cross(omega, p)))
    return motions + [(R.T @ omega, R.T @ alpha, a)]


def _newton_euler(robot: RobotModel, q: ca.SX, w: ca.SX, v: ca.SX, payload: ca.SX) -> ca.SX:
    """τ = M(q) v + C(q, w) w + g(q); every vector of link i is in the axes of link i."""
    model, n = robot.pin_model, robot.n
    axes = [_exact(_axis(model.joints[i])) for i in range(1, n + 1)]
    poses = [_link_pose(model, i, q[i - 1]) for i in range(1, n + 1)]
    bodies = [_Body.from_parameters(_exact(model.inertias[i].toDynamicParameters())) for i in range(1, n + 1)]

    *link_motions, flange_motion = _motions(robot, q, w, v)
    wrenches = [body.wrench(*motion) for body, motion in zip(bodies, link_motions, strict=True)]

    R, p = _exact(robot.T_last_flange.rotation), _exact(robot.T_last_flange.translation)
    force, moment = _Body.from_parameters(payload).wrench(*flange_motion)

    torque = [ca.SX(0)] * n
    for i in reversed(range(n)):
        own_force, own_moment = wrenches[i]
        moment = own_moment + R @ moment + ca.cross(p, R @ force)
        force = own_force + R @ force
        torque[i] = ca.dot(axes[i], moment) + float(model.armature[i]) * v[i]
        R, p = poses[i]
    return ca.vertcat(*torque)


def _cached(robot: RobotModel, name: str, build: Callable[[], ca.Function]) -> ca.Function:
    if name not in robot.symbolic_cache:
        robot.symbolic_cache[name] = build()
    return robot.symbolic_cache[name]


def flange_pose(robot: RobotModel) -> ca.Function:
    """Forward kinematics q (n,) → R (3, 3), p (3,) of T_world_flange."""

    def build() -> ca.Function:
        q = ca.SX.sym("q", robot.n)
        R, p = ca.SX.eye(3), ca.SX.zeros(3)
        for i in range(1, robot.n + 1):
            R_i, p_i = _link_pose(robot.pin_model, i, q[i - 1])
            R, p = R @ R_i, p + R @ p_i
        T = robot.T_last_flange
        return ca.Function(
            "flange_pose", [q], [R @ _exact(T.rotation), p + R @ _exact(T.translation)], ["q"], ["R", "p"]
        )

    return _cached(robot, "flange_pose", build)


def torque(robot: RobotModel) -> ca.Function:
    """Torque rows (q (n,), v (n,), payload (10,)) → M(q) v + g(q), (n,) in Nm, armature included.

    Coriolis and centrifugal torques are left out; `JointLimits.coriolis` bounds them. `robot.payload` is not used: what
    the flange carries is the argument, so that one function serves the empty and the loaded hand.
    """

    def build() -> ca.Function:
        q, v = ca.SX.sym("q", robot.n), ca.SX.sym("v", robot.n)
        payload = ca.SX.sym("payload", PAYLOAD_SIZE)
        tau = _newton_euler(robot, q, ca.SX.zeros(robot.n), v, payload)
        return ca.Function("torque", [q, v, payload], [tau], ["q", "v", "payload"], ["tau"])

    return _cached(robot, "torque", build)


def full_inverse_dynamics(robot: RobotModel) -> ca.Function:
    """(q (n,), w (n,), v (n,), payload (10,)) → M(q) v + C(q, w) w + g(q), (n,) in Nm, armature included."""

    def build() -> ca.Function:
        q, w, v = (ca.SX.sym(name, robot.n) for name in ("q", "w", "v"))
        payload = ca.SX.sym("payload", PAYLOAD_SIZE)
        tau = _newton_euler(robot, q, w, v, payload)
        return ca.Function("full_inverse_dynamics", [q, w, v, payload], [tau], ["q", "w", "v", "payload"], ["tau"])

    return _cached(robot, "full_inverse_dynamics", build)


def payload_wrench(robot: RobotModel) -> ca.Function:
    """(q (n,), w (n,), v (n,), payload (10,)) → force (3,), moment (3,) about the flange origin, in flange axes.

    In N and Nm: what the flange exerts on a payload, its weight included: the last link of the recursion of
    `full_inverse_dynamics`.
    """

    def build() -> ca.Function:
        q, w, v = (ca.SX.sym(name, robot.n) for name in ("q", "w", "v"))
        payload = ca.SX.sym("payload", PAYLOAD_SIZE)
        wrench = _Body.from_parameters(payload).wrench(*_motions(robot, q, w, v)[-1])
        names = ["q", "w", "v", "payload"]
        return ca.Function("payload_wrench", [q, w, v, payload], list(wrench), names, ["force", "moment"])

    return _cached(robot, "payload_wrench", build)


def payload_vector(inertia: pin.Inertia) -> Array:
    """(10,) payload argument of `torque` for an inertia in the flange frame."""
    return np.array(inertia.toDynamicParameters())


def grasp_point(gripper: GripperModel) -> ca.Function:
    """p_G: q_h (m,) → (3,) in the hand frame, the midpoint of the two pads' arc centres."""

    def build() -> ca.Function:
        q_h = ca.SX.sym("q_h", gripper.m)
        model = gripper.pin_model
        index = {name: i for i, name in enumerate(gripper.joint_names)}
        centres = ca.SX.zeros(3)
        for pad in gripper.pad_ids:
            frame = model.frames[pad]
            point, i = _exact(frame.placement.translation), frame.parentJoint
            while i > 0:
                name = model.names[i]
                angle = q_h[index[name]] if name in index else ca.SX(gripper.locked[name])
                R, p = _link_pose(model, i, angle)
                point, i = p + R @ point, model.parents[i]
            centres += point
        return ca.Function("grasp_point", [q_h], [centres / 2], ["q_h"], ["p_G"])

    if "grasp_point" not in gripper.symbolic_cache:
        gripper.symbolic_cache["grasp_point"] = build()
    return gripper.symbolic_cache["grasp_point"]
