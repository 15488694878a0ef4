"""The constraints of the three phases, each written once as a symbolic function of one grid point.

Whatever a pose, a part or a gripper changes is a parameter: one function serves an arm for good, so that derivatives
and compiled code are made once. Functions are kept in `RobotModel.symbolic_cache`, which copies with other payloads
share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from dyngrasp.errors import InvalidProblem
from dyngrasp.models import symbolic
from dyngrasp.models.pinch import Pinch, pad_loads
from dyngrasp.models.robot import RobotModel
from dyngrasp.planning.problem import NodeConstraint
from dyngrasp.signals import Array, frozen

if TYPE_CHECKING:
    from dyngrasp.models.grasp_object import Funnel


def torque_rows(robot: RobotModel, intervals: int, fraction: float = 1.0) -> NodeConstraint:
    """∓(fraction · τmax − c) around M(q) v + g(q), eq. (3e): the Coriolis torque is not in the row, its bound c is.

    Args:
        robot: The arm with what it carries as its payload.
        intervals: N.
        fraction: Part of the torque limits to use; what is left serves the controller.

    Raises:
        InvalidProblem: Nothing is left of a limit after the bound.
    """
    bound = fraction * robot.limits.torque - robot.limits.coriolis
    if not (bound > 0).all():
        i = int(bound.argmin())
        raise InvalidProblem(
            f"{fraction:g} of the torque limit {robot.limits.torque[i]:g} Nm of {robot.joint_names[i]} is less than "
            f"the bound of its Coriolis torque, {robot.limits.coriolis[i]:g} Nm"
        )
    payload = _at_each(intervals + 1, symbolic.payload_vector(robot.payload))
    return NodeConstraint("torque", symbolic.torque(robot), payload, -bound, bound, robot.limits.torque)


def funnel(
    robot: RobotModel,
    p_flange_grasp: ArrayLike,
    T_world_grasp: pin.SE3 | Sequence[pin.SE3],
    shape: Funnel,
    margin: float = 0.0,
) -> NodeConstraint:
    """G stays above the inverted Gaussian, eqs. (5) and (6): h = z − z_th (1 − exp(−½ (x²/σx² + y²/σy²))) ≥ 0.

    Above z_th it holds by itself, so that one row serves the whole approach. Equivalent rows with a gentler wall (h
    over the length of its gradient, logarithms) converge worse, see decision 0003; what h needs is a start that already
    comes down the funnel.

    Args:
        robot: The arm.
        p_flange_grasp: (N+1, 3) G in the flange frame at each grid point (m).
        T_world_grasp: The grasp frame, z outward along the approach axis; one for each grid point if the part moves.
        shape: z_th, σx, σy (m).
        margin: h ≥ margin at the grid points (m), for what happens between them.
    """
    points = _points(p_flange_grasp)
    widths = np.array([shape.z_threshold, shape.sigma_x, shape.sigma_y])
    parameters = _at_each(len(points), points, _frames(T_world_grasp, len(points)), widths)

    def build() -> ca.Function:
        q, v, p = _inputs(robot, 18)
        G, _, _ = _in_grasp_frame(robot, q, p[:3], p[3:15])
        height, sigma_x, sigma_y = p[15], p[16], p[17]
        h = G[2] - height * (1 - ca.exp(-((G[0] / sigma_x) ** 2 + (G[1] / sigma_y) ** 2) / 2))
        return ca.Function("funnel", [q, v, p], [h], ["q", "v", "p"], ["g"])

    function = _cached(robot, "funnel", build)
    return NodeConstraint("funnel", function, parameters, _bound(margin), _bound(np.inf), _bound(shape.z_threshold))


def grasp_tube(
    robot: RobotModel,
    p_flange_grasp: ArrayLike,
    R_flange_grasp: ArrayLike,
    T_world_grasp: pin.SE3 | Sequence[pin.SE3],
    lateral: float = 0.0015,
    dip: float = 0.003,
    tilt: float = np.deg2rad(1.0),
) -> NodeConstraint:
    """While the hand closes, G stays on the grasp axis and the hand in its orientation.

    Rows: x² + y² ≤ lateral² and z ≥ −dip of G in the grasp frame, and 3 − trace(R) = 4 sin²(θ/2) for the angle θ
    between the hand and the grasp frame. The squares are smooth on the axis itself, where the motion begins and ends.

    Args:
        robot: The arm.
        p_flange_grasp: (N+1, 3) G in the flange frame (m): it moves as the fingers close.
        R_flange_grasp: (3, 3) axes of the hand's grasp frame in the flange frame.
        T_world_grasp: The grasp frame; one for each grid point if the part moves.
        lateral: How far G may leave the grasp axis (m), > 0.
        dip: How far G may pass below the grasp frame (m), > 0.
        tilt: How far the hand may turn against the grasp frame (rad), > 0.
    """
    points = _points(p_flange_grasp)
    axes = np.asarray(R_flange_grasp, dtype=float).ravel()
    parameters = _at_each(len(points), points, axes, _frames(T_world_grasp, len(points)))

    def build() -> ca.Function:
        q, v, p = _inputs(robot, 24)
        G, R, R_world_grasp = _in_grasp_frame(robot, q, p[:3], p[12:24])
        hand = R @ _matrix(p[3:12])
        rows = ca.vertcat(G[0] ** 2 + G[1] ** 2, G[2], 3 - ca.sum1(ca.sum2(R_world_grasp * hand)))
        return ca.Function("grasp_tube", [q, v, p], [rows], ["q", "v", "p"], ["g"])

    function = _cached(robot, "grasp_tube", build)
    twist = 4 * np.sin(tilt / 2) ** 2
    return NodeConstraint(
        "grasp_tube",
        function,
        parameters,
        _bound(-np.inf, -dip, -np.inf),
        _bound(lateral**2, np.inf, twist),
        _bound(lateral**2, dip, twist),
    )


def hold(
    robot: RobotModel,
    part: pin.Inertia,
    T_flange_grasp: pin.SE3,
    pinch: Pinch,
    velocity: ArrayLike,
    safety: float = 1.4,
    closing_share: float = 0.5,
) -> NodeConstraint:
    """The pinch carries the part: what each pad bears under the part's acceleration, see `models.pinch.pad_loads`.

    A fast delivery loads the pads as much by its velocities as by its accelerations. They enter as given numbers, as
    rows are functions of q and v alone: those of a motion near the one that is sought. Rows: for each pad its load less
    what its normal force allows, ≤ 0 with the safety factor; and the force along the closing axis over N, which
    shifts load from one pad to the other.

    Args:
        robot: The arm.
        part: Inertia of the part in the flange frame.
        T_flange_grasp: The grasp frame in the flange frame as the closed hand holds it, y along the closing axis.
        pinch: The grip.
        velocity: (N+1, n) q̇ expected at each grid point (rad/s).
        safety: ≥ 1; covers other velocities, transients, and friction and mass that are not as assumed.
        closing_share: Part of N that acceleration may add to or take from one pad, in (0, 1).
    """
    if safety < 1 or not 0 < closing_share < 1:
        raise InvalidProblem(f"safety must be ≥ 1 and the closing share in (0, 1); got {safety}, {closing_share}")
    grip = _bound(pinch.force, pinch.sliding, pinch.torsional, pinch.width, safety)
    velocity = np.asarray(velocity, dtype=float)

    def build() -> ca.Function:
        q, v, p = _inputs(robot, 27 + robot.n)
        force, moment = symbolic.payload_wrench(robot)(q, p[27:], v, p[:10])
        axes, origin, grip = _matrix(p[10:19]), p[19:22], p[22:27]
        moment -= ca.cross(origin, force)
        F, M = axes.T @ force, axes.T @ moment
        loads = pad_loads(ca.vertsplit(F), ca.vertsplit(M), Pinch(grip[0], grip[1], grip[2], grip[3]))
        rows = [load - (normal / grip[4]) ** 2 for load, normal in loads]
        return ca.Function("hold", [q, v, p], [ca.vertcat(*rows, F[1] / grip[0])], ["q", "v", "p"], ["g"])

    function = _cached(robot, "hold", build)
    scale = _bound(1 / safety**2, 1 / safety**2, closing_share)
    lower, upper = _bound(-np.inf, -np.inf, -closing_share), _bound(0.0, 0.0, closing_share)
    parameters = _at_each(len(velocity), symbolic.payload_vector(part), _frame(T_flange_grasp), grip, velocity)
    return NodeConstraint("hold", function, parameters, lower, upper, scale)


# The carried part is well above the ground after this part of the delivery, by LIFT_CLEARANCE (m): more than it sags in
# the hand, so that it leaves the ground for good.
LIFT_SHARE = 0.2
LIFT_CLEARANCE = 0.003


def above_ground(robot: RobotModel, points: ArrayLike, floor: ArrayLike) -> NodeConstraint:
    """The carried part stays out of the ground: the corners of its underside keep above a floor.

    The paper has no such row; with time-optimal weights the part would dig an edge into the ground as it is lifted.

    Args:
        robot: The arm.
        points: (K, 3) corners in the flange frame (m).
        floor: (N+1, K) least height of each corner at each grid point (m); see `lift_floor`.
    """
    corners, floor = _points(points), np.asarray(floor, dtype=float)
    count = len(corners)
    if floor.ndim != 2 or floor.shape[1] != count:
        raise InvalidProblem(f"a floor of shape (N+1, {count}) expected, got {floor.shape}")

    def build() -> ca.Function:
        q, v, p = _inputs(robot, 4 * count)
        R, position = symbolic.flange_pose(robot)(q)
        corner, level = ca.reshape(p[: 3 * count], 3, count), p[3 * count :]
        rows = position[2] + (R[2, :] @ corner).T - level
        return ca.Function("above_ground", [q, v, p], [rows], ["q", "v", "p"], ["g"])

    function = _cached(robot, f"above_ground_{count}", build)
    parameters = _at_each(len(floor), corners.ravel(), floor)
    return NodeConstraint(
        "above_ground", function, parameters, np.zeros(count), np.full(count, np.inf), np.full(count, 0.01)
    )


def lift_floor(start: ArrayLike, end: ArrayLike, intervals: int, depth: float = 1e-4) -> Array:
    """Least heights of a part's corners over the delivery: from where they stand up to `LIFT_CLEARANCE`.

    Args:
        start: (K,) heights at the grasp (m); an estimate may put a standing part a little into the ground.
        end: (K,) heights at the target (m).
        intervals: N of the grid.
        depth: Rounding allowed (m), > 0, so that a part that stands is not at the very edge of what is allowed.

    Returns:
        (N+1, K) heights (m).
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    lowest, end_height = np.minimum(start, 0.0), float(end.min())
    # A target on or in the ground is the user's wish; then the part only has to stay above both ends.
    goal = LIFT_CLEARANCE if end_height > LIFT_CLEARANCE else min(end_height, 0.0)
    return lowest + _risen(intervals) * np.maximum(goal - lowest, 0.0) - depth


@lru_cache(maxsize=64)
def _risen(intervals: int) -> Array:
    """(N+1, 1) parts of the way up. Quadratic, so that a delivery that begins at rest can follow."""
    return frozen(np.minimum(np.linspace(0.0, 1.0, intervals + 1) / LIFT_SHARE, 1.0)[:, None] ** 2)


def _in_grasp_frame(robot: RobotModel, q: ca.SX, p_G: ca.SX, frame: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """G in the grasp frame, the flange's rotation and the grasp frame's, both in the world."""
    R, p = symbolic.flange_pose(robot)(q)
    R_world_grasp, t = _matrix(frame[:9]), frame[9:12]
    return R_world_grasp.T @ (p + R @ p_G - t), R, R_world_grasp


def _cached(robot: RobotModel, name: str, build: Callable[[], ca.Function]) -> ca.Function:
    key = f"planning.{name}"
    if key not in robot.symbolic_cache:
        robot.symbolic_cache[key] = build()
    return robot.symbolic_cache[key]


def _inputs(robot: RobotModel, parameters: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("q", robot.n), ca.SX.sym("v", robot.n), ca.SX.sym("p", parameters)


def _matrix(row_major: ca.SX) -> ca.SX:
    return ca.reshape(row_major, 3, 3).T


def _frame(T: pin.SE3) -> Array:
    return np.concatenate([T.rotation.ravel(), T.translation])


def _frames(T: pin.SE3 | Sequence[pin.SE3], count: int) -> Array:
    """(12,) numbers of one frame, or (count, 12) of as many."""
    if isinstance(T, pin.SE3):
        return _frame(T)
    if len(T) != count:
        raise InvalidProblem(f"one frame for each of the {count} grid points expected, got {len(T)}")
    return np.stack([_frame(each) for each in T])


def _points(p_flange_grasp: ArrayLike) -> Array:
    points = np.asarray(p_flange_grasp, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidProblem(f"one point of three coordinates for each grid point expected, got shape {points.shape}")
    return points


def _at_each(points: int, *parts: Array) -> Array:
    """Parameters at all grid points, side by side: a part is (k,), the same at each of them, or (points, k)."""
    parameters = np.empty((points, sum(part.shape[-1] for part in parts)))
    column = 0
    for part in parts:
        parameters[:, column : column + part.shape[-1]] = part
        column += part.shape[-1]
    return frozen(parameters)


def _bound(*values: float) -> Array:
    return frozen(np.array(values))
