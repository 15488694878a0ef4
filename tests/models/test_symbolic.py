"""Kinematics and dynamics, three ways: our CasADi recursion, Pinocchio, MuJoCo, which share no code."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models import symbolic
from dyngrasp.models.catalogue import load_robot

STATES = 50

# Sums of some hundred products of numbers up to 10² at a rounding of 1e-16.
ROUNDING_NM = 1e-11
# MuJoCo keeps a body's inertia by its principal axes: an eigendecomposition and a quaternion more.
MUJOCO_NM = 1e-10
ROUNDING_M = 1e-14


@pytest.fixture
def states(robot):
    return np.random.default_rng(1).uniform(-2.5, 2.5, (STATES, 3, robot.n))


def test_torque_rows_match_pinocchio(robot, payload, states):
    loaded, rows = robot.with_payload(payload), symbolic.torque(robot)
    p = symbolic.payload_vector(payload)
    for q, _, v in states:
        expected = loaded.inverse_dynamics(q, np.zeros(robot.n), v)
        np.testing.assert_allclose(rows(q, v, p).full().ravel(), expected, rtol=0, atol=ROUNDING_NM)
        np.testing.assert_allclose(
            loaded.mass_matrix(q) @ v + loaded.gravity_torque(q), expected, rtol=0, atol=ROUNDING_NM
        )


def test_torque_rows_match_mujoco(robot, payload, states, mujoco_arm):
    model, data = mujoco_arm(robot, payload)
    rows, p = symbolic.torque(robot), symbolic.payload_vector(payload)
    M = np.zeros((robot.n, robot.n))
    for q, _, v in states:
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        np.testing.assert_allclose(rows(q, v, p).full().ravel(), M @ v + data.qfrc_bias, rtol=0, atol=MUJOCO_NM)


def test_inverse_dynamics_matches_mujoco(robot, payload, states, mujoco_arm):
    model, data = mujoco_arm(robot, payload)
    loaded = robot.with_payload(payload)
    full, p = symbolic.full_inverse_dynamics(robot), symbolic.payload_vector(payload)
    for q, w, v in states:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, w, v
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(full(q, w, v, p).full().ravel(), data.qfrc_inverse, rtol=0, atol=MUJOCO_NM)
        np.testing.assert_allclose(loaded.inverse_dynamics(q, w, v), data.qfrc_inverse, rtol=0, atol=MUJOCO_NM)


def test_without_payload_the_zero_vector_is_the_bare_arm(robot, states, mujoco_arm):
    model, data = mujoco_arm(robot)
    full = symbolic.full_inverse_dynamics(robot)
    for q, w, v in states[:10]:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, w, v
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(
            full(q, w, v, np.zeros(10)).full().ravel(), data.qfrc_inverse, rtol=0, atol=MUJOCO_NM
        )


def test_bias_torque_is_what_speed_adds(robot, payload, states):
    loaded = robot.with_payload(payload)
    for q, w, v in states[:10]:
        slow = loaded.mass_matrix(q) @ v + loaded.gravity_torque(q)
        np.testing.assert_allclose(
            loaded.bias_torque(q, w) + slow, loaded.inverse_dynamics(q, w, v), rtol=0, atol=ROUNDING_NM
        )


def test_flange_pose_matches_pinocchio_and_mujoco(robot, states, mujoco_arm):
    model, data = mujoco_arm(robot)
    site = model.site(robot.tip_frame).id
    for q, _, _ in states:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        rotation, position = symbolic.flange_pose(robot)(q)
        T = robot.forward_kinematics(q)
        for found_R, found_p in ((rotation.full(), position.full().ravel()), (T.rotation, T.translation)):
            # MuJoCo goes through quaternions, normalised body by body.
            np.testing.assert_allclose(found_R, data.site_xmat[site].reshape(3, 3), rtol=0, atol=ROUNDING_M * 10)
            np.testing.assert_allclose(found_p, data.site_xpos[site], rtol=0, atol=ROUNDING_M * 10)


def test_jacobian_is_the_derivative_of_the_flange_pose(robot, states):
    # Central differences at h = 1e-6: truncation about h² = 1e-12, rounding 1e-16 / h = 1e-10.
    h = 1e-6
    for q, _, _ in states[:20]:
        J, T = robot.jacobian(q), robot.forward_kinematics(q)
        for i in range(robot.n):
            step = h * np.eye(robot.n)[i]
            ahead, behind = robot.forward_kinematics(q + step), robot.forward_kinematics(q - step)
            linear = (ahead.translation - behind.translation) / (2 * h)
            angular = (pin.log3(ahead.rotation @ T.rotation.T) - pin.log3(behind.rotation @ T.rotation.T)) / (2 * h)
            np.testing.assert_allclose(J[:, i], np.concatenate([linear, angular]), rtol=0, atol=3e-9)


def test_functions_are_built_once_and_shared_with_loaded_copies(robot, payload):
    assert symbolic.torque(robot) is symbolic.torque(robot.with_payload(payload))


def test_grasp_point_matches_the_hand(gripper):
    p_G = symbolic.grasp_point(gripper)
    for q_h in np.random.default_rng(2).uniform(gripper.lower, gripper.upper, (STATES, gripper.m)):
        np.testing.assert_allclose(p_G(q_h).full().ravel(), gripper.grasp_point(q_h), rtol=0, atol=ROUNDING_M)


def test_iiwa_torque_rows_stay_small():
    # About 720 operations were counted for this arm without a payload; losing the exact zeros doubles them.
    assert symbolic.torque(load_robot("iiwa14")).n_instructions() < 800
