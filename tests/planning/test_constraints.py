"""Each constraint against Pinocchio and the paper's formulas, its derivatives against finite differences."""

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.catalogue import load_gripper, load_robot
from dyngrasp.models.grasp_object import Funnel
from dyngrasp.models.pinch import Pinch, pad_loads
from dyngrasp.planning import constraints
from dyngrasp.planning.problem import NodeConstraint

N = 12
FUNNEL = Funnel(z_threshold=0.1, sigma_x=0.005, sigma_y=0.002)
PINCH = Pinch(force=13.0, sliding=0.7, torsional=0.008, width=0.034)
PART = pin.Inertia(0.75, np.array([0.004, -0.012, 0.16]), np.array([[9, 1, 2], [1, 8, -1], [2, -1, 3]]) * 1e-4)


@pytest.fixture(scope="module")
def iiwa():
    return load_robot("iiwa14")


@pytest.fixture(scope="module")
def sdh2():
    return load_gripper("sdh2")


@pytest.fixture(scope="module")
def T_flange_grasp(sdh2):
    return sdh2.T_flange_hand * sdh2.T_hand_grasp(sdh2.closed_posture)


@pytest.fixture(scope="module")
def states(iiwa):
    random = np.random.default_rng(4)
    q = random.uniform(0.9 * iiwa.limits.position_lower, 0.9 * iiwa.limits.position_upper, (N + 1, iiwa.n))
    return q, random.uniform(-4, 4, (N + 1, iiwa.n))


def near(iiwa, T_flange_grasp, q, random) -> pin.SE3:
    """A grasp frame a few millimetres and degrees from where the hand is at q."""
    offset = pin.SE3(pin.exp3(random.normal(size=3) * 0.02), random.normal(size=3) * [0.004, 0.002, 0.03])
    return iiwa.forward_kinematics(q) * T_flange_grasp * offset


def everything(iiwa, sdh2, T_flange_grasp, states) -> list[NodeConstraint]:
    points = np.tile(T_flange_grasp.translation, (N + 1, 1))
    T = near(iiwa, T_flange_grasp, states[0][0], np.random.default_rng(0))
    return [
        constraints.torque_rows(iiwa.with_payload(PART), N, 0.9),
        constraints.funnel(iiwa, points, T, FUNNEL),
        constraints.grasp_tube(iiwa, points, T_flange_grasp.rotation, T),
        constraints.hold(iiwa, PART, T_flange_grasp, PINCH, states[1]),
    ]


def evaluate(constraint: NodeConstraint, q, v, k: int = 0) -> np.ndarray:
    return constraint.function(q, v, constraint.parameters[k]).full().ravel()


def test_torque_rows_are_the_dynamics_at_rest(iiwa, states):
    loaded = iiwa.with_payload(PART)
    constraint = constraints.torque_rows(loaded, N, 0.9)
    for q, v in zip(*states, strict=True):
        expected = loaded.inverse_dynamics(q, np.zeros(iiwa.n), v)
        # Sums of some hundred products of numbers up to 10².
        np.testing.assert_allclose(evaluate(constraint, q, v), expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(constraint.upper, 0.9 * iiwa.limits.torque - iiwa.limits.coriolis)
    np.testing.assert_array_equal(constraint.lower, -constraint.upper)


def test_no_torque_left_is_refused(iiwa):
    with pytest.raises(InvalidProblem, match="Coriolis"):
        constraints.torque_rows(iiwa, N, 1e-6)


def test_funnel_row_is_the_papers_h(iiwa, T_flange_grasp, states):
    random = np.random.default_rng(1)
    points = np.tile(T_flange_grasp.translation, (N + 1, 1)) + random.normal(size=(N + 1, 3)) * 0.003
    inside = 0
    for k, q in enumerate(states[0]):
        T = near(iiwa, T_flange_grasp, q, random)
        constraint = constraints.funnel(iiwa, points, T, FUNNEL, margin=0.001)
        x, y, z = T.actInv(iiwa.forward_kinematics(q).act(points[k]))
        offset = np.array([x, y])
        Sigma = np.diag([FUNNEL.sigma_x**2, FUNNEL.sigma_y**2])
        p = FUNNEL.z_threshold * (1 - np.exp(-0.5 * offset @ np.linalg.inv(Sigma) @ offset))
        # h climbs up to 30 m per metre at the wall, so 1e-15 m in the kinematics is 3e-14 here.
        assert evaluate(constraint, q, np.zeros(7), k)[0] == pytest.approx(z - p, abs=1e-13)
        inside += z - p > 0
    assert 0 < inside < N + 1, "both sides of the surface belong into this test"
    assert constraint.lower[0] == 0.001


def test_funnel_lets_everything_pass_above_its_threshold(iiwa, T_flange_grasp, states):
    hand = iiwa.forward_kinematics(states[0][0]) * T_flange_grasp
    points = np.tile(T_flange_grasp.translation, (N + 1, 1))
    for aside in (0.0, 0.003, 0.05, 1.0):
        for height, passes in ((0.1001, True), (0.0999, aside <= 0.0)):
            T = hand * pin.SE3(np.eye(3), np.array([0.0, -aside * 10, -height]))
            constraint = constraints.funnel(iiwa, points, T, FUNNEL)
            assert (evaluate(constraint, states[0][0], np.zeros(7))[0] >= 0) == passes


def test_grasp_tube_rows(iiwa, T_flange_grasp, states):
    random = np.random.default_rng(2)
    points = np.tile(T_flange_grasp.translation, (N + 1, 1))
    for q in states[0]:
        T = near(iiwa, T_flange_grasp, q, random)
        constraint = constraints.grasp_tube(iiwa, points, T_flange_grasp.rotation, T, 0.002, 0.004, 0.03)
        hand = iiwa.forward_kinematics(q) * T_flange_grasp
        x, y, z = T.actInv(hand.translation)
        angle = np.linalg.norm(pin.log3(T.rotation.T @ hand.rotation))
        values = evaluate(constraint, q, np.zeros(7))
        np.testing.assert_allclose(values, [x**2 + y**2, z, 4 * np.sin(angle / 2) ** 2], rtol=0, atol=1e-14)
        within = (np.hypot(x, y) <= 0.002, z >= -0.004, angle <= 0.03)
        np.testing.assert_array_equal((constraint.lower <= values) & (values <= constraint.upper), within)


def test_hold_is_the_wrench_of_the_part_shared_by_two_pads(iiwa, T_flange_grasp, states):
    w = np.random.default_rng(8).uniform(-2, 2, (N + 1, iiwa.n))
    constraint = constraints.hold(iiwa, PART, T_flange_grasp, PINCH, w, safety=1.5, closing_share=0.4)
    model, data = iiwa.pin_model, iiwa.pin_model.createData()
    for k, (q, v) in enumerate(zip(*states, strict=True)):
        pin.forwardKinematics(model, data, q, w[k], v)
        pin.updateFramePlacement(model, data, iiwa.tip_id)
        acceleration = pin.getFrameAcceleration(model, data, iiwa.tip_id, pin.LOCAL)
        acceleration.linear -= data.oMf[iiwa.tip_id].rotation.T @ model.gravity.linear
        velocity = pin.getFrameVelocity(model, data, iiwa.tip_id, pin.LOCAL)
        wrench = T_flange_grasp.actInv(PART * acceleration + velocity.cross(PART * velocity))
        expected = [load - (normal / 1.5) ** 2 for load, normal in pad_loads(wrench.linear, wrench.angular, PINCH)]
        expected.append(wrench.linear[1] / PINCH.force)
        np.testing.assert_allclose(evaluate(constraint, q, v, k), expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(constraint.upper, [0.0, 0.0, 0.4])


def test_what_the_pads_bear_balances_the_wrench():
    """Solve the statics of two contacts from scratch: six equations for the forces and torsions of two pads."""
    random = np.random.default_rng(7)
    half = np.array([0.0, PINCH.width / 2, 0.0])
    for _ in range(50):
        force, moment = random.normal(size=3) * 5, random.normal(size=3) * 0.05
        # Unknowns: the forces at +y and at −y, and the torsion about y of both together. Statics leaves the squeeze
        # open; the least-norm solution has none.
        rows = np.zeros((6, 7))
        rows[:3, :3] = rows[:3, 3:6] = np.eye(3)
        rows[3:, :3], rows[3:, 3:6] = pin.skew(half), pin.skew(-half)
        rows[4, 6] = 1.0
        solved = np.linalg.lstsq(rows, np.concatenate([force, moment]), rcond=None)[0]
        loads = pad_loads(force, moment, PINCH)
        # A force on the part towards +y relieves the pad at +y, which pushes towards −y.
        for (load, normal), contact, inward in zip(loads, (solved[:3], solved[3:6]), (-1.0, 1.0), strict=True):
            tangential = np.hypot(contact[0], contact[2]) / (PINCH.sliding * PINCH.force)
            torsion = moment[1] / (2 * PINCH.torsional * PINCH.force)
            assert load == pytest.approx(tangential**2 + torsion**2, rel=1e-10)
            assert normal == pytest.approx(1 + inward * contact[1] / PINCH.force, rel=1e-10)


def test_the_floor_under_a_carried_part():
    floor = constraints.lift_floor([0.0, -0.002], [0.3, 0.3], 10, depth=1e-4)
    np.testing.assert_allclose(floor[0], [-1e-4, -0.0021])
    np.testing.assert_allclose(floor[2:], constraints.LIFT_CLEARANCE - 1e-4)
    # A target on the ground can be reached.
    on_ground = constraints.lift_floor([0.0, 0.0], [0.0, 0.3], 10)
    assert (on_ground[-1] <= 0.0).all()


def test_above_ground_is_the_height_of_the_corners(iiwa, states):
    corners = np.random.default_rng(5).normal(size=(8, 3)) * 0.1
    floor = np.random.default_rng(6).normal(size=(N + 1, 8)) * 0.01
    constraint = constraints.above_ground(iiwa, corners, floor)
    for k, q in enumerate(states[0]):
        heights = [iiwa.forward_kinematics(q).act(corner)[2] for corner in corners]
        np.testing.assert_allclose(evaluate(constraint, q, np.zeros(7), k), heights - floor[k], rtol=0, atol=1e-14)


@pytest.mark.parametrize("which", range(4), ids=["torque", "funnel", "grasp_tube", "hold"])
def test_derivatives_match_finite_differences(iiwa, sdh2, T_flange_grasp, states, which):
    constraint = everything(iiwa, sdh2, T_flange_grasp, states)[which]
    x = ca.SX.sym("x", 14)
    g = constraint.function(x[:7], x[7:], constraint.parameters[0])
    weights = np.random.default_rng(3).normal(size=g.numel())
    jacobian = ca.Function("jacobian", [x], [ca.densify(ca.jacobian(g, x))])
    hessian, gradient = ca.hessian(ca.dot(ca.DM(weights), g), x)
    second = ca.Function("second", [x], [ca.densify(gradient), ca.densify(hessian)])
    here, step = np.concatenate([states[0][0], states[1][0]]), 1e-6

    def slope(function):
        columns = [(function(here + step * e) - function(here - step * e)) / (2 * step) for e in np.eye(14)]
        return np.array(columns).T

    expected = slope(lambda at: ca.evalf(constraint.function(at[:7], at[7:], constraint.parameters[0])).full().ravel())
    found = jacobian(here).full()
    # Central differences: step² times the third derivative, and rounding over the step, relative to the largest entry.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(found).max())
    expected = slope(lambda at: second(at)[0].full().ravel())
    found = second(here)[1].full()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(found).max())


def test_functions_are_built_once_for_all_payloads_and_poses(iiwa, sdh2, T_flange_grasp, states):
    first = everything(iiwa, sdh2, T_flange_grasp, states)
    second = everything(iiwa.with_payload(PART), sdh2, T_flange_grasp * T_flange_grasp, states)
    for a, b in zip(first, second, strict=True):
        assert a.function.__hash__() == b.function.__hash__()


@pytest.mark.parametrize("bad", [{"safety": 0.9}, {"closing_share": 1.0}])
def test_senseless_hold_is_refused(iiwa, T_flange_grasp, bad):
    with pytest.raises(InvalidProblem, match="safety"):
        constraints.hold(iiwa, PART, T_flange_grasp, PINCH, np.zeros((N + 1, 7)), **bad)


def test_a_frame_for_each_grid_point_is_that_of_a_part_that_moves(iiwa):
    points = np.tile([0.0, 0.0, 0.3], (5, 1))
    frames = [pin.SE3(pin.utils.rotate("z", 0.1 * k), np.array([0.6, 0.01 * k, 0.2])) for k in range(5)]
    moving = constraints.funnel(iiwa, points, frames, FUNNEL)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(
            moving.parameters[k], constraints.funnel(iiwa, points, frame, FUNNEL).parameters[k]
        )
    with pytest.raises(InvalidProblem):
        constraints.grasp_tube(iiwa, points, np.eye(3), frames[:4])
