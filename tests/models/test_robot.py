import re

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import ModelFileError
from dyngrasp.models.catalogue import ROBOTS, load_robot
from dyngrasp.models.robot import read_robot

IIWA = ROBOTS["iiwa14"] / "model.toml"


def edited(path, folder, replacements):
    """A copy of a model.toml in `folder` with some text replaced, its description named by absolute path."""
    text = path.read_text()
    for old, new in replacements:
        assert re.search(old, text), f"{old} does not occur"
        text = re.sub(old, new, text, count=1)
    name = re.search(r'mjcf = "(.*)"', text)
    if name and not (folder / name.group(1)).exists():
        text = text.replace(name.group(0), f'mjcf = "{path.parent / name.group(1)}"')
    (folder / "edited.toml").write_text(text)
    return folder / "edited.toml"


def test_iiwa_at_zero_stands_straight_up():
    robot = load_robot("iiwa14")
    np.testing.assert_allclose(robot.forward_kinematics(np.zeros(7)).translation, [0, 0, 1.306], atol=1e-12)
    assert robot.n == 7
    assert robot.joint_names == ("A1", "A2", "A3", "A4", "A5", "A6", "A7")
    assert robot.mass == pytest.approx(29.9, abs=0.01)


def test_iiwa_limits_are_those_of_its_description():
    robot = load_robot("iiwa14")
    np.testing.assert_allclose(robot.limits.position_lower, robot.pin_model.lowerPositionLimit, atol=1e-9)
    np.testing.assert_allclose(robot.limits.position_upper, robot.pin_model.upperPositionLimit, atol=1e-9)
    np.testing.assert_allclose(robot.limits.torque, robot.pin_model.effortLimit)


def test_payloads_add_up(payload):
    arm = load_robot("iiwa14")
    half = pin.Inertia(payload.mass / 2, payload.lever, payload.inertia / 2)
    once, twice = arm.with_payload(payload), arm.with_payload(half).with_payload(half)
    q, w, v = np.random.default_rng(0).uniform(-2, 2, (3, 7))
    np.testing.assert_allclose(twice.inverse_dynamics(q, w, v), once.inverse_dynamics(q, w, v), atol=1e-12)
    assert not arm.payload.mass
    assert once.forward_kinematics(q).isApprox(arm.forward_kinematics(q), 1e-14)


def test_holding_the_payload_takes_its_weight(payload):
    """Statics: the extra torque is Jᵀ of the weight at the payload's centre of mass."""
    arm = load_robot("iiwa14")
    q = np.random.default_rng(1).uniform(-2, 2, 7)
    lever = arm.forward_kinematics(q).rotation @ payload.lever
    weight = np.array([0, 0, payload.mass * 9.81])
    expected = arm.jacobian(q).T @ np.concatenate([weight, np.cross(lever, weight)])
    extra = arm.with_payload(payload).gravity_torque(q) - arm.gravity_torque(q)
    np.testing.assert_allclose(extra, expected, atol=1e-11)


def test_results_are_copies():
    robot = load_robot("iiwa14")
    g = robot.gravity_torque(np.zeros(7))
    T = robot.forward_kinematics(np.zeros(7))
    kept, moved = g.copy(), T.translation.copy()
    robot.gravity_torque(np.ones(7))
    robot.forward_kinematics(np.ones(7))
    np.testing.assert_array_equal(g, kept)
    np.testing.assert_array_equal(T.translation, moved)


@pytest.mark.parametrize("n", [6, 7, 8])
def test_urdf_and_mjcf_of_the_same_arm_agree(make_chain, n):
    from_mjcf, from_urdf = read_robot(make_chain(n)), read_robot(make_chain(n, description="urdf"))
    assert from_urdf.mjcf_path is None
    assert from_urdf.urdf_path is not None
    for q, w, v in np.random.default_rng(n).uniform(-2.5, 2.5, (20, 3, n)):
        # The URDF states rotations as three angles: one more rounding of 1e-16, times torques of 10² Nm.
        np.testing.assert_allclose(
            from_urdf.inverse_dynamics(q, w, v), from_mjcf.inverse_dynamics(q, w, v), rtol=0, atol=1e-10
        )
        assert from_urdf.forward_kinematics(q).isApprox(from_mjcf.forward_kinematics(q), 1e-12)


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        (r"torque_nm = \[320.0, ", "torque_nm = [", "limits.torque_nm", "7 numbers"),
        (r"torque_nm = \[320.0", "torque_nm = [nan", "limits.torque_nm[0]", "finite"),
        (r"torque_nm = \[320.0", "torque_nm = [-320.0", "limits.torque_nm[0]", "greater than 0"),
        (r"velocity_deg_per_s", "velocity_rad_per_s", "limits.velocity_rad_per_s", "velocity_deg_per_s"),
        (r"lower_deg = \[-170.0", "lower_deg = [171.0", "limits.position_lower_deg[0]", "less than the upper"),
        (r"upper_deg = \[170.0", "upper_deg = [190.0", "limits.position_upper_deg[0]", "within the range"),
        (r'tip_frame = "flange"', 'tip_frame = "hand"', "tip_frame", "flange"),
        (r'tip_frame = "flange"', 'tip_frame = "link_4"', "tip_frame", "behind the last joint"),
        (r'mjcf = "iiwa14.xml"', 'mjcf = "absent.xml"', "mjcf", "exists"),
        (r'mjcf = "iiwa14.xml"', 'mjcf = "iiwa14.xml"\nurdf = "a.urdf"', "mjcf", "exactly one"),
        (r'mjcf = "iiwa14.xml"\n', "", "mjcf", "exactly one"),
        (r'kinematics = "srs"', 'kinematics = "general"', "srs", "no such table"),
        (r"elbow_to_wrist = 0.400", "elbow_to_wrist = 0.390", "srs", "flange position"),
        (r"coriolis_bound_nm = \[[0-9.]+", "coriolis_bound_nm = [400.0", "limits.coriolis_bound_nm[0]", "less than"),
        (r'kind = "robot"', 'kind = "gripper"', "kind", "robot"),
        (r'mjcf = "iiwa14.xml"', 'mjcf = "iiwa14.xml"\narmature_kg_m2 = [1.0]', "armature_kg_m2", "MJCF states"),
    ],
)
def test_a_bad_model_file_names_the_key(tmp_path, old, new, key, says):
    path = edited(IIWA, tmp_path, [(old, new)])
    with pytest.raises(ModelFileError, match=re.escape(says)) as caught:
        read_robot(path)
    assert caught.value.key == key
    assert str(path) in str(caught.value)


LINK = "<inertial pos='0 0 .1' mass='1' diaginertia='.01 .01 .01'/>"


@pytest.mark.parametrize(
    ("description", "says"),
    [
        ("<mujoco><worldbody><body name='a'>", "valid MJCF"),
        (f"<mujoco><worldbody><body name='a'>{LINK}<site name='tip'/></body></worldbody></mujoco>", "at least one"),
        (
            f"<mujoco><worldbody><body name='a'><joint name='j' type='slide'/>{LINK}<site name='tip'/></body>"
            "</worldbody></mujoco>",
            "'j' is P",
        ),
        (
            f"<mujoco><worldbody><body name='a'><freejoint name='j'/>{LINK}<site name='tip'/></body>"
            "</worldbody></mujoco>",
            "revolute joints",
        ),
        (
            f"<mujoco><worldbody><body name='a'><joint name='j' range='-1 1'/>{LINK}"
            f"<body name='b'><joint name='k' range='-1 1'/>{LINK}</body>"
            f"<body name='c'><joint name='l' range='-1 1'/>{LINK}<site name='tip'/></body></body></worldbody></mujoco>",
            "'l' branches off at 'j'",
        ),
        (
            "<mujoco><worldbody><body name='a'><joint name='j' range='-1 1'/>"
            "<inertial pos='0 0 0' mass='0' diaginertia='.01 .01 .01'/><site name='tip'/></body></worldbody></mujoco>",
            "a mass > 0",
        ),
        (
            "<mujoco><worldbody><body name='a'><joint name='j' range='-1 1'/>"
            "<inertial pos='0 0 0' mass='nan' diaginertia='.01 .01 .01'/><site name='tip'/></body>"
            "</worldbody></mujoco>",
            "mjcf",
        ),
        (
            "<mujoco><worldbody><body name='a'><joint name='j' range='-1 1'/>"
            "<inertial pos='0 0 0' mass='1' diaginertia='.01 .01 -.01'/><site name='tip'/></body></worldbody></mujoco>",
            "positive definite",
        ),
        (
            "<mujoco><worldbody><body name='a'><joint name='j' range='-1 1'/>"
            "<inertial pos='0 0 0' mass='1' diaginertia='.01 .01 .03'/><site name='tip'/></body></worldbody></mujoco>",
            "which no body has",
        ),
    ],
)
def test_a_bad_description_is_refused(tmp_path, description, says):
    (tmp_path / "arm.xml").write_text(description)
    (tmp_path / "model.toml").write_text(
        "kind='robot'\nname='x'\nmjcf='arm.xml'\ntip_frame='tip'\n[limits]\nposition_lower_deg=[-10]\n"
        "position_upper_deg=[10]\nvelocity_deg_per_s=[10]\ntorque_nm=[10]\n"
    )
    with pytest.raises(ModelFileError, match=re.escape(says)):
        read_robot(tmp_path / "model.toml")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("type='revolute'", "type='prismatic'", "revolute joints"),
        ("type='revolute'", "type='continuous'", "revolute joints"),
        (r"<inertial>.*?</inertial>", "", "a mass > 0"),
        ("<robot", "<robo", "valid URDF"),
    ],
)
def test_a_bad_urdf_is_refused(make_chain, old, new, says):
    path = make_chain(6, description="urdf")
    urdf = path.parent / "arm.urdf"
    urdf.write_text(re.sub(old, new, urdf.read_text(), count=1))
    with pytest.raises(ModelFileError, match=says):
        read_robot(path)


def test_mujoco_accepts_what_is_accepted(make_chain):
    """The generated arms are bodies that can exist, so that a refusal above is due to what was changed."""
    path = make_chain(8)
    assert read_robot(path).n == mujoco.MjModel.from_xml_path(str(path.parent / "arm.xml")).nv == 8
