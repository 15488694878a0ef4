"""Arm and hand as one tree, against MuJoCo with the two descriptions attached to one another."""

import re
import warnings

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import ModelFileError
from dyngrasp.models.assembly import assemble
from dyngrasp.models.catalogue import GRIPPERS, load_gripper, load_robot
from dyngrasp.models.gripper_file import read_gripper
from dyngrasp.models.robot import read_robot

SDH2 = GRIPPERS["sdh2"] / "model.toml"


@pytest.fixture(scope="module")
def tilted_gripper(tmp_path_factory):
    """The hand on an adapter, so that a mount applied twice, inverted or not at all shows."""
    text = SDH2.read_text().replace('mjcf = "sdh2.xml"', f'mjcf = "{SDH2.parent / "sdh2.xml"}"')
    text = text.replace("position = [0.0, 0.0, 0.0]", "position = [0.01, -0.02, 0.03]")
    text = text.replace("quat_wxyz = [1.0, 0.0, 0.0, 0.0]", "quat_wxyz = [0.5, 0.5, -0.1, 0.7]")
    path = tmp_path_factory.mktemp("tilted") / "model.toml"
    path.write_text(text)
    return read_gripper(path)


@pytest.fixture(scope="module", params=["as shipped", "tilted"])
def assembly(request, tilted_gripper):
    gripper = load_gripper("sdh2") if request.param == "as shipped" else tilted_gripper
    return assemble(load_robot("iiwa14"), gripper)


@pytest.fixture(scope="module")
def attached(assembly):
    robot, gripper = assembly.robot, assembly.gripper
    spec = mujoco.MjSpec.from_file(str(robot.mjcf_path))
    site = spec.site(robot.tip_frame)
    T = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3([*site.pos, *np.roll(site.quat, -1)]) * gripper.T_flange_hand)
    frame = site.parent.add_frame(pos=T[:3], quat=np.roll(T[3:], 1))
    spec.attach(mujoco.MjSpec.from_file(str(gripper.mjcf_path)), frame=frame, prefix="")
    with warnings.catch_warnings():  # it warns of the empty prefix; the names of arm and hand differ
        warnings.simplefilter("ignore", UserWarning)
        model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_damping[:] = 0.0
    return model, mujoco.MjData(model)


@pytest.fixture
def states(assembly):
    n, m = assembly.robot.n, assembly.gripper.m
    return np.random.default_rng(4).uniform(-1.5, 1.5, (30, 3, n + m))


def put(assembly, attached, x, w=None, v=None):
    model, data = attached
    n = assembly.robot.n
    for name, angle in assembly.gripper.locked.items():
        data.joint(name).qpos[0] = angle
    for target, values in (("qpos", x), ("qvel", w), ("qacc", v)):
        for i, name in enumerate(assembly.robot.joint_names + assembly.gripper.joint_names):
            getattr(data.joint(name), target)[0] = 0.0 if values is None else values[i]
    assert n + assembly.gripper.m == len(x)
    return model, data


def test_arm_joints_come_first_then_the_planned_joints(assembly):
    assert tuple(assembly.pin_model.names)[1:] == assembly.robot.joint_names + assembly.gripper.joint_names
    both = assembly.configuration(np.arange(7), np.arange(7, 11))
    np.testing.assert_array_equal(both, np.arange(11))


def test_full_dynamics_match_mujoco(assembly, attached, states):
    data_pin = assembly.pin_model.createData()
    for x, w, v in states:
        arguments = [assembly.configuration(a[:7], a[7:]) for a in (x, w, v)]
        found = pin.rnea(assembly.pin_model, data_pin, *arguments)
        model, data = put(assembly, attached, x, w, v)
        mujoco.mj_inverse(model, data)
        names = assembly.robot.joint_names + assembly.gripper.joint_names
        expected = [data.joint(name).qfrc_inverse[0] for name in names]
        # Both read the same decimals; MuJoCo keeps inertias by principal axes.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_still_hand_is_a_payload(assembly, states):
    robot, gripper = assembly.robot, assembly.gripper
    data_pin = assembly.pin_model.createData()
    for x, w, v in states:
        q_h, still = x[7:], np.zeros(gripper.m)
        arguments = [assembly.configuration(*a) for a in ((x[:7], q_h), (w[:7], still), (v[:7], still))]
        whole = pin.rnea(assembly.pin_model, data_pin, *arguments)[assembly.arm_indices]
        lumped = robot.with_payload(gripper.payload(q_h)).inverse_dynamics(x[:7], w[:7], v[:7])
        np.testing.assert_allclose(whole, lumped, rtol=0, atol=1e-11)


def test_exactly_the_collision_geoms_arrive(assembly, attached):
    model, _ = attached
    names = [geom.name for geom in assembly.geometry.geometryObjects]
    expected = [model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
    assert sorted(names) == sorted(expected)
    assert sorted(names) == sorted(assembly.arm_geoms + assembly.hand_geoms)
    assert set(assembly.pad_geoms) <= set(assembly.hand_geoms)
    assert len(assembly.geometry.collisionPairs) == 0


def size(shape):
    kind = type(shape).__name__
    if kind == "Box":
        return np.array(shape.halfSide)
    if kind == "Ellipsoid":
        return np.array(shape.radii)
    if kind == "Sphere":
        return np.array([shape.radius, 0.0, 0.0])
    return np.array([shape.radius, shape.halfLength, 0.0])


def test_geoms_are_where_and_as_large_as_in_mujoco(assembly, attached, states):
    data_pin, geometry_data = assembly.pin_model.createData(), assembly.geometry.createData()
    kinds = set()
    for x, _, _ in states[:10]:
        pin.updateGeometryPlacements(
            assembly.pin_model, data_pin, assembly.geometry, geometry_data, assembly.configuration(x[:7], x[7:])
        )
        model, data = put(assembly, attached, x)
        mujoco.mj_kinematics(model, data)
        for geom, found in zip(assembly.geometry.geometryObjects, geometry_data.oMg, strict=True):
            expected = data.geom(geom.name)
            kind = mujoco.mjtGeom(model.geom(geom.name).type[0]).name.removeprefix("mjGEOM_").capitalize()
            assert type(geom.geometry).__name__ == kind
            kinds.add(kind)
            np.testing.assert_allclose(found.translation, expected.xpos, rtol=0, atol=1e-12, err_msg=geom.name)
            shapes = []
            for rotation in (found.rotation, expected.xmat.reshape(3, 3)):
                # Capsules and cylinders are round about z and alike at both ends: only the line of z counts.
                round_about_z = kind in ("Capsule", "Cylinder")
                shapes.append(np.outer(rotation[:, 2], rotation[:, 2]) if round_about_z else rotation)
            np.testing.assert_allclose(shapes[0], shapes[1], rtol=0, atol=1e-12, err_msg=geom.name)
            used = {"Capsule": 2, "Cylinder": 2, "Sphere": 1}.get(kind, 3)
            np.testing.assert_allclose(size(geom.geometry)[:used], model.geom(geom.name).size[:used], atol=1e-12)
    assert kinds >= {"Capsule", "Cylinder", "Box", "Ellipsoid"}


def test_grasp_frame_follows_flange_mount_and_fingers(assembly, attached, states):
    gripper = assembly.gripper
    for x, _, _ in states:
        T = assembly.robot.forward_kinematics(x[:7]) * gripper.T_flange_hand * gripper.T_hand_grasp(x[7:])
        model, data = put(assembly, attached, x)
        mujoco.mj_kinematics(model, data)
        centre = np.mean([data.site(pad).xpos for pad in gripper.pads], axis=0)
        np.testing.assert_allclose(T.translation, centre, rtol=0, atol=1e-12)


def test_an_arm_from_urdf_takes_the_hand_too(make_chain):
    urdf = assemble(read_robot(make_chain(6, description="urdf")), load_gripper("sdh2"))
    mjcf = assemble(read_robot(make_chain(6)), load_gripper("sdh2"))
    for x, w, v in np.random.default_rng(5).uniform(-1.5, 1.5, (5, 3, 10)):
        torques = []
        for whole in (urdf, mjcf):
            arguments = [whole.configuration(a[:6], a[6:]) for a in (x, w, v)]
            torques.append(pin.rnea(whole.pin_model, whole.pin_model.createData(), *arguments))
        np.testing.assert_allclose(torques[0], torques[1], rtol=0, atol=1e-10)


def test_shared_names_are_refused(tmp_path, make_chain):
    path = make_chain(6)
    xml = path.parent / "arm.xml"
    xml.write_text(xml.read_text().replace("joint_3", "h2"))
    with pytest.raises(ModelFileError, match=re.escape("['h2']")):
        assemble(read_robot(path), load_gripper("sdh2"))
