"""The compiled kinematics and dynamics against Pinocchio, for the iiwa and for chains about random axes."""

import numpy as np
import pinocchio as pin
import pytest
from numba import njit

from dyngrasp.lanes import LANES, load, store
from dyngrasp.models.assembly import assemble
from dyngrasp.models.batch_dynamics import BatchModel, cosine_sine, wrench_on
from dyngrasp.models.catalogue import load_robot
from dyngrasp.models.newton_euler import newton_euler
from dyngrasp.models.robot import read_robot

M = 60


@pytest.fixture
def motion(robot):
    """Positions, velocities and accelerations, (n, M) each."""
    return np.random.default_rng(1).normal(size=(3, robot.n, M))


def one_by_one(*motion):
    """(q, w, v) of each sample."""
    return zip(*(x.T for x in motion), strict=True)


def test_torques_are_pinocchios(robot, payload, motion):
    loaded = robot.with_payload(payload)
    torque, _ = BatchModel.from_pinocchio(loaded.loaded_model).inverse_dynamics(*motion)
    expected = np.transpose([loaded.inverse_dynamics(*sample) for sample in one_by_one(*motion)])
    # Some thousand roundings of torques up to 10³ Nm.
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_gravity_and_armature_are_the_models(robot):
    model = pin.Model(robot.loaded_model)
    model.gravity.linear = np.array([1.0, -2.0, 3.0])
    q, zero = np.random.default_rng(2).normal(size=(robot.n, M)), np.zeros((robot.n, M))
    torque, _ = BatchModel.from_pinocchio(model).inverse_dynamics(q, zero, zero)
    expected = np.transpose([pin.computeGeneralizedGravity(model, model.createData(), x) for x in q.T])
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    model.armature = model.armature + 7.0
    heavier, _ = BatchModel.from_pinocchio(model).inverse_dynamics(q, zero, zero + 1.0)
    model.armature = model.armature - 7.0
    lighter, _ = BatchModel.from_pinocchio(model).inverse_dynamics(q, zero, zero + 1.0)
    np.testing.assert_allclose(heavier - lighter, 7.0, rtol=0, atol=1e-11)


def test_poses_of_frames_on_any_link_and_on_the_world(robot, motion):
    model, data, tree = robot.pin_model, robot.pin_model.createData(), BatchModel.from_pinocchio(robot.pin_model)
    offset = pin.SE3(pin.exp3(np.array([0.3, -1.2, 0.7])), np.array([0.1, -0.2, 0.3]))
    R, p = tree.poses(motion[0], tree.attach([(joint, offset) for joint in range(model.njoints)]))
    for k, q in enumerate(motion[0].T):
        pin.forwardKinematics(model, data, q)
        for joint in range(model.njoints):
            expected = data.oMi[joint] * offset
            np.testing.assert_allclose(R[joint, ..., k], expected.rotation, rtol=0, atol=1e-13)
            np.testing.assert_allclose(p[joint, :, k], expected.translation, rtol=0, atol=1e-13)


def test_poses_of_a_tree_that_branches(gripper):
    assembly = assemble(load_robot("iiwa14"), gripper)
    model, geometry = assembly.pin_model, assembly.geometry
    assert len(set(model.parents)) < model.njoints, "the fingers branch off"
    tree = BatchModel.from_pinocchio(model)
    frames = tree.attach([(int(body.parentJoint), pin.SE3(body.placement)) for body in geometry.geometryObjects])
    data, placed = model.createData(), pin.GeometryData(geometry)
    postures = np.random.default_rng(3).normal(size=(20, model.nq))
    R, p = tree.poses(np.ascontiguousarray(postures.T), frames)
    for k, q in enumerate(postures):
        pin.updateGeometryPlacements(model, data, geometry, placed, q)
        expected = [(placed.oMg[i].rotation, placed.oMg[i].translation) for i in range(len(geometry.geometryObjects))]
        np.testing.assert_allclose(R[..., k], [rotation for rotation, _ in expected], rtol=0, atol=1e-13)
        np.testing.assert_allclose(p[..., k], [position for _, position in expected], rtol=0, atol=1e-13)


def test_wrench_is_what_a_body_on_the_flange_adds_at_the_last_joint(robot, payload, motion):
    """Its power on the last link must be that of the torques which the payload adds."""
    tree = BatchModel.from_pinocchio(robot.pin_model)
    bare, tip = tree.inverse_dynamics(*motion)
    loaded = robot.with_payload(payload)
    on_flange = tree.attach([(robot.n, robot.T_last_flange)])
    T = pin.SE3(on_flange.rotations[0], on_flange.positions[0])
    wrench = wrench_on(T.act(payload), tip)
    model, data = robot.pin_model, robot.pin_model.createData()
    for k, (q, w, v) in enumerate(one_by_one(*motion)):
        J = pin.computeFrameJacobian(model, data, q, robot.tip_id, pin.LOCAL)
        at_flange = T.actInv(pin.Force(wrench[:, k])).vector
        expected = loaded.inverse_dynamics(q, w, v) - bare[:, k]
        np.testing.assert_allclose(J.T @ at_flange, expected, rtol=0, atol=1e-11 * np.abs(bare).max())


def test_a_body_on_the_last_link_counts_at_the_samples_that_have_it(robot, payload, motion):
    bare, loaded = (BatchModel.from_pinocchio(one.loaded_model) for one in (robot, robot.with_payload(payload)))
    more = [getattr(loaded, name)[-1] - getattr(bare, name)[-1] for name in ("mass", "first_moment", "inertia")]
    # Full from a sample on that is none of the first of eight, and half of it at the last one.
    share = np.concatenate([np.zeros(21), np.ones(M - 22), [0.5]])
    q, w, v = motion
    torque, _ = newton_euler(q, w, v, bare.chain, (float(more[0]), more[1], more[2]), share)
    without, whole = bare.inverse_dynamics(*motion)[0], loaded.inverse_dynamics(*motion)[0]
    expected = without + share * (whole - without)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12 * np.abs(whole).max())


def test_other_joints_are_refused():
    model = pin.Model()
    model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    with pytest.raises(ValueError, match="PX"):
        BatchModel.from_pinocchio(model)


def test_not_a_number_goes_through(make_chain):
    robot = read_robot(make_chain(3))
    q = np.zeros((3, 2))
    q[0, 1] = np.nan
    torque, _ = BatchModel.from_pinocchio(robot.pin_model).inverse_dynamics(q, np.zeros((3, 2)), np.zeros((3, 2)))
    assert np.isfinite(torque[:, 0]).all()
    assert np.isnan(torque[:, 1]).any()


@njit
def cosines_and_sines(angles):
    out = np.empty((2, angles.size))
    for at in range(0, angles.size, LANES):
        cosine, sine = cosine_sine(load(angles, at, angles.size - at))
        store(cosine, out[0], at, angles.size - at)
        store(sine, out[1], at, angles.size - at)
    return out


@pytest.mark.parametrize("largest", [0.8, 10.0, 1e6])
def test_cosine_and_sine_are_the_mathematical_librarys(largest):
    angles = np.random.default_rng(4).uniform(-largest, largest, (7, 5000))
    # Multiples of a quarter turn are where the pieces meet.
    angles[0, :9] = np.arange(-4, 5) * np.pi / 2
    angles[1, :9] = np.arange(-4, 5) * np.pi / 2 + np.pi / 4
    cosine, sine = cosines_and_sines(angles.ravel())
    np.testing.assert_allclose(cosine, np.cos(angles.ravel()), rtol=0, atol=5e-16)
    np.testing.assert_allclose(sine, np.sin(angles.ravel()), rtol=0, atol=5e-16)
    assert np.isnan(cosines_and_sines(np.array([np.nan, np.inf, -np.inf]))).all()
