import re

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import GraspRefused, ModelFileError
from dyngrasp.models.catalogue import GRIPPERS
from dyngrasp.models.gripper_file import read_gripper

SDH2 = GRIPPERS["sdh2"] / "model.toml"


@pytest.fixture
def postures(gripper):
    return np.random.default_rng(3).uniform(gripper.lower, gripper.upper, (40, gripper.m))


@pytest.fixture(scope="module")
def hand(gripper):
    model = mujoco.MjModel.from_xml_path(str(gripper.mjcf_path))
    return model, mujoco.MjData(model)


def put(hand, gripper, q_h):
    model, data = hand
    for name, angle in [*gripper.locked.items(), *zip(gripper.joint_names, q_h, strict=True)]:
        data.joint(name).qpos[0] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return model, data


def test_grasp_point_is_the_midpoint_of_the_pad_sites(gripper, hand, postures):
    for q_h in postures:
        _, data = put(hand, gripper, q_h)
        centres = np.array([data.site(pad).xpos for pad in gripper.pads])
        # Rounding of lengths of 0.3 m, through quaternions in MuJoCo.
        np.testing.assert_allclose(gripper.pad_centres(q_h), centres, rtol=0, atol=1e-14)
        np.testing.assert_allclose(gripper.grasp_point(q_h), centres.mean(axis=0), rtol=0, atol=1e-14)
    expected = [gripper.grasp_point(q) for q in postures]
    np.testing.assert_allclose(gripper.grasp_point_many(postures), expected, rtol=0, atol=1e-15)


def test_inertia_is_that_of_all_bodies(gripper, hand, postures):
    for q_h in postures:
        model, data = put(hand, gripper, q_h)
        total = pin.Inertia.Zero()
        for body in range(1, model.nbody):
            pose = pin.SE3(data.ximat[body].reshape(3, 3), data.xipos[body])
            total += pose.act(pin.Inertia(model.body_mass[body], np.zeros(3), np.diag(model.body_inertia[body])))
        found = gripper.inertia(q_h)
        assert found.mass == pytest.approx(model.body_subtreemass[0], rel=1e-12)
        np.testing.assert_allclose(found.lever, data.subtree_com[0], rtol=0, atol=1e-12)
        # MuJoCo diagonalises each body's inertia, of 1e-3 kg m² at most.
        np.testing.assert_allclose(found.inertia, total.inertia, rtol=0, atol=1e-12)


def test_grasp_point_jacobian_is_its_derivative(gripper, postures):
    h = 1e-6  # truncation h² = 1e-12, rounding 1e-16 / h = 1e-10
    for q_h in postures:
        steps = h * np.eye(gripper.m)
        ahead, behind = gripper.grasp_point_many(q_h + steps), gripper.grasp_point_many(q_h - steps)
        np.testing.assert_allclose(gripper.grasp_point_jacobian(q_h), (ahead - behind).T / (2 * h), rtol=0, atol=1e-9)


def test_aperture_is_the_distance_between_pad_surfaces(gripper):
    """Where the pads are parallel, the arcs' apexes lie on their x axes, a radius from the centres."""
    for fraction in np.linspace(0, 1, 11):
        q_h = gripper.closing_posture(fraction)
        pin.framesForwardKinematics(gripper.pin_model, gripper._data, gripper.full_configuration(q_h))
        poses = [gripper._data.oMf[i] for i in gripper.pad_ids]
        apexes = [pose.act(np.array([gripper.pad_radius, 0, 0])) for pose in poses]
        gap = (apexes[0] - apexes[1]) @ gripper.closing_axis
        assert gripper.aperture(q_h) == pytest.approx(gap, abs=1e-9)


def test_sdh2_opens_and_closes_as_its_file_says(gripper):
    # The postures in the file have eight decimals, times twice a finger of 0.0865 m.
    assert gripper.max_aperture == pytest.approx(0.094, abs=1e-8)
    assert gripper.min_aperture == pytest.approx(0.0, abs=1e-8)
    heights = gripper.grasp_point_many([gripper.open_posture, gripper.posture_for(0.034)])[:, 2]
    # Why arm and hand share a clock: the grasp point travels some millimetres as the fingers close on a rib.
    assert 0.003 < heights[1] - heights[0] < 0.007


@pytest.mark.parametrize("gap", [0.0, 0.001, 0.034, 0.06, 0.0939])
def test_posture_for_a_gap_makes_that_gap(gripper, gap):
    assert gripper.aperture(gripper.posture_for(gap)) == pytest.approx(gap, abs=1e-9)


@pytest.mark.parametrize("gap", [-0.01, 0.0942, 0.2, float("nan")])
def test_a_gap_out_of_range_is_refused_with_the_number(gripper, gap):
    with pytest.raises(GraspRefused, match=r"94\.0 mm"):
        gripper.posture_for(gap)


def test_grasp_frame_faces_the_approach(gripper):
    q_h = gripper.posture_for(0.03)
    T = gripper.T_hand_grasp(q_h)
    np.testing.assert_allclose(T.rotation[:, 2], -gripper.approach_axis)
    np.testing.assert_allclose(T.rotation[:, 1], gripper.closing_axis)
    assert np.linalg.det(T.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(T.translation, gripper.grasp_point(q_h))


def test_payload_is_the_inertia_seen_from_the_flange(gripper):
    q_h = gripper.open_posture
    found, at_hand = gripper.payload(q_h), gripper.inertia(q_h)
    np.testing.assert_allclose(found.lever, gripper.T_flange_hand.act(at_hand.lever))
    assert found.mass == pytest.approx(1.95, abs=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        (r'joints = \["h2"', 'joints = ["h9"', "joints", "joints of the description"),
        (r'joints = \["h2", ', "joints = [", "locked", "either planned or locked"),
        (r"h1 = -1.57[0-9]*", "h1 = -1.8", "locked.h1", "within the range"),
        (r"h1 = -1.57[0-9]*\n", "", "locked", "either planned or locked"),
        (r'pads = \["pad_1"', 'pads = ["pad_9"', "pads[0]", "pad_1"),
        (r'pads = \["pad_1", "pad_3"\]', 'pads = ["pad_3", "pad_1"]', "postures", "shrinks"),
        (r'pad_geoms = \["pad_1"', 'pad_geoms = ["pad_1_strip_1"', "pad_geoms[0]", "collision geom"),
        (r"pad_radius = 0.025", "pad_radius = -0.025", "pad_radius", "greater than 0"),
        (r"closing_axis = \[0.0, 1.0, 0.0\]", "closing_axis = [0.0, 0.0, 1.0]", "closing_axis", "perpendicular"),
        (r"approach_axis = \[0.0, 0.0, 1.0\]", "approach_axis = [0.0, 0.0, 2.0]", "approach_axis", "unit vector"),
        (r"open = \[-0.3[0-9]*", "open = [-2.0", "postures.open[0]", "within the limits"),
        (r"open = \[-0.3[0-9]*, ", "open = [", "postures.open", "4 numbers"),
        (r"lower_deg = \[-90.0", "lower_deg = [95.0", "limits.position_lower_deg[0]", "less than the upper"),
        (r"lower_deg = \[-90.0", "lower_deg = [-100.0", "limits.position_lower_deg[0]", "within the range"),
        (r"quat_wxyz = \[1.0, 0.0", "quat_wxyz = [1.0, 1.0", "mount.quat_wxyz", "unit quaternion"),
        (r"force_n = 16.0", "force_n = 0.0", "pinch.force_n", "greater than 0"),
    ],
)
def test_a_bad_model_file_names_the_key(tmp_path, old, new, key, says):
    text = SDH2.read_text().replace('mjcf = "sdh2.xml"', f'mjcf = "{SDH2.parent / "sdh2.xml"}"')
    assert re.search(old, text)
    (tmp_path / "model.toml").write_text(re.sub(old, new, text, count=1))
    with pytest.raises(ModelFileError, match=re.escape(says)) as caught:
        read_gripper(tmp_path / "model.toml")
    assert caught.value.key == key
