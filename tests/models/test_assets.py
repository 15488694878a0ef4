# SPDX-License-Identifier: Apache-2.0
"""The iiwa 14 and SDH2 model files: one truth, read alike by Pinocchio and MuJoCo, that agrees with its sources."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

ASSETS = Path(str(files("dyngrasp") / "models" / "assets"))
ARM = ASSETS / "robots" / "iiwa14"
HAND = ASSETS / "grippers" / "sdh2"
MJCF = {"iiwa14": ARM / "iiwa14.xml", "sdh2": HAND / "sdh2.xml"}

# Both libraries evaluate the same closed formulas in double precision: torques of 100 Nm leave about 1e-13.
EXACT = 1e-9

Q_START_DEG = (55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0)
Q_TARGET_DEG = (0.0, 0.0, 0.0, -40.0, 0.0, 100.0, 90.0)


def read_toml(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "model.toml").read_text(encoding="utf-8"))


def arm_with_hand() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(MJCF["iiwa14"]))
    spec.attach(mujoco.MjSpec.from_file(str(MJCF["sdh2"])), prefix="hand/", site=spec.site("flange"))
    return spec.compile()


def site_pose(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> pin.SE3:
    i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    assert i >= 0, name
    return pin.SE3(data.site_xmat[i].reshape(3, 3).copy(), data.site_xpos[i].copy())


def geom_ids(model: mujoco.MjModel, *, containing: str) -> list[int]:
    return [i for i in range(model.ngeom) if containing in model.geom(i).name and model.geom(i).contype[0]]


def hand_data(model: mujoco.MjModel, posture: list[float]) -> mujoco.MjData:
    """Places the hand alone at its locked angles and the planned joints at `posture`."""
    toml = read_toml(HAND)
    data = mujoco.MjData(model)
    for name, angle in [*toml["locked"].items(), *zip(toml["joints"], posture, strict=True)]:
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    return data


def parallel(gap: float) -> list[float]:
    """Joint angles with parallel pads and the given free gap (m), from the lengths in the sources."""
    proximal = float(np.arcsin((0.033 + 0.012 - 0.025 - gap / 2) / 0.0865))
    return [proximal, -proximal, proximal, -proximal]


@pytest.mark.parametrize("name", MJCF)
def test_pinocchio_and_mujoco_read_the_same_model(name: str) -> None:
    model = mujoco.MjModel.from_xml_path(str(MJCF[name]))
    data = mujoco.MjData(model)
    robot = pin.buildModelFromMJCF(str(MJCF[name]))
    scratch = robot.createData()
    assert [model.joint(i).name for i in range(model.njnt)] == list(robot.names)[1:]
    np.testing.assert_allclose(robot.lowerPositionLimit, model.jnt_range[:, 0], atol=EXACT)
    np.testing.assert_allclose(robot.upperPositionLimit, model.jnt_range[:, 1], atol=EXACT)
    np.testing.assert_allclose(robot.armature, model.dof_armature, atol=EXACT)
    assert model.dof_armature.min() > 0.0
    limited = model.jnt_actfrclimited.astype(bool)
    np.testing.assert_allclose(robot.upperEffortLimit[limited], model.jnt_actfrcrange[limited, 1], atol=EXACT)
    rng = np.random.default_rng(2)
    for _ in range(50):
        q = rng.uniform(model.jnt_range[:, 0], model.jnt_range[:, 1])
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        mass_matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass_matrix)
        upper = np.triu(pin.crba(robot, scratch, q))
        np.testing.assert_allclose(upper + np.triu(upper, 1).T, mass_matrix, atol=EXACT)
        np.testing.assert_allclose(pin.computeGeneralizedGravity(robot, scratch, q), data.qfrc_bias, atol=EXACT)
        pin.framesForwardKinematics(robot, scratch, q)
        for i in range(model.nsite):
            frame = scratch.oMf[robot.getFrameId(model.site(i).name)]
            np.testing.assert_allclose(
                frame.homogeneous, site_pose(model, data, model.site(i).name).homogeneous, atol=EXACT
            )


@pytest.mark.parametrize(("name", "mass"), [("iiwa14", 29.9), ("sdh2", 1.95)])
def test_total_mass(name: str, mass: float) -> None:
    # The link masses are given to 1e-6 kg (arm) and the total of the hand to 0.01 kg, filled up exactly.
    assert mujoco.MjModel.from_xml_path(str(MJCF[name])).body_mass.sum() == pytest.approx(mass, abs=5e-6)


def test_flange_height_at_zero_is_the_sum_of_the_srs_offsets() -> None:
    model = mujoco.MjModel.from_xml_path(str(MJCF["iiwa14"]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pose = site_pose(model, data, "flange")
    np.testing.assert_allclose(pose.translation, [0.0, 0.0, 1.306], atol=EXACT)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=EXACT)
    assert sum(read_toml(ARM)["srs"].values()) == pytest.approx(1.306, abs=EXACT)


@pytest.mark.parametrize("folder", [ARM, HAND])
def test_limits_of_the_toml_agree_with_the_mjcf(folder: Path) -> None:
    toml = read_toml(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / toml["mjcf"]))
    names = toml.get("joints", [model.joint(i).name for i in range(model.njnt)])
    rows = [model.joint(name).id for name in names]
    limits = toml["limits"]
    np.testing.assert_allclose(np.deg2rad(limits["position_lower_deg"]), model.jnt_range[rows, 0], atol=EXACT)
    np.testing.assert_allclose(np.deg2rad(limits["position_upper_deg"]), model.jnt_range[rows, 1], atol=EXACT)
    np.testing.assert_allclose(limits["torque_nm"], model.jnt_actfrcrange[rows, 1], atol=EXACT)
    assert all(len(row) == len(names) for row in limits.values())


def test_joint_4_turns_as_the_papers_target_needs_it() -> None:
    """A2 and A6 turn about +y, A4 about -y: at q_T the approach axis is 40 + 100 deg from straight up, 40 from down."""
    model = mujoco.MjModel.from_xml_path(str(MJCF["iiwa14"]))
    data = mujoco.MjData(model)
    data.qpos[:] = np.deg2rad(Q_TARGET_DEG)
    mujoco.mj_forward(model, data)
    approach = site_pose(model, data, "flange").rotation[:, 2]
    tilt = np.rad2deg(np.arccos(-approach[2]))
    assert tilt == pytest.approx(40.0, abs=1e-6)
    assert approach[0] > 0.0


def test_start_of_the_paper_lies_over_the_ground_within_the_limits() -> None:
    model = mujoco.MjModel.from_xml_path(str(MJCF["iiwa14"]))
    data = mujoco.MjData(model)
    q = np.deg2rad(Q_START_DEG)
    assert np.all(q > model.jnt_range[:, 0])
    assert np.all(q < model.jnt_range[:, 1])
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    pose = site_pose(model, data, "flange")
    # The hand reaches 0.1595 m beyond the flange; the paper's parts lie 0.6 to 0.7 m in front of the base.
    assert (pose.translation + 0.1595 * pose.rotation[:, 2])[2] > 0.1
    assert 0.5 < np.linalg.norm(pose.translation[:2]) < 0.9


@pytest.mark.parametrize(("posture", "gap"), [("open", 0.094), ("closed", 0.0)])
def test_pads_are_parallel_with_the_stated_gap(posture: str, gap: float) -> None:
    toml = read_toml(HAND)
    model = mujoco.MjModel.from_xml_path(str(MJCF["sdh2"]))
    data = hand_data(model, toml["postures"][posture])
    finger_1, finger_3 = (site_pose(model, data, name) for name in toml["pads"])
    closing, approach = np.array(toml["closing_axis"]), np.array(toml["approach_axis"])
    np.testing.assert_allclose(finger_1.rotation[:, 0], -closing, atol=1e-8)
    np.testing.assert_allclose(finger_3.rotation[:, 0], closing, atol=1e-8)
    np.testing.assert_allclose(finger_1.rotation[:, 2], approach, atol=1e-8)
    # The postures are written with 8 decimals.
    apart = (finger_1.translation - finger_3.translation) @ closing - 2 * toml["pad_radius"]
    assert apart == pytest.approx(gap, abs=1e-8)
    # The collision pads stop where the arcs do. MuJoCo's distance of ellipsoids is iterative: 20 micrometres.
    between = np.zeros(6)
    ends = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in toml["pad_geoms"]]
    assert mujoco.mj_geomDistance(model, data, ends[0], ends[1], 1.0, between) == pytest.approx(gap, abs=2e-5)


def test_grasp_point_travels_along_the_approach_axis_while_closing() -> None:
    toml = read_toml(HAND)
    model = mujoco.MjModel.from_xml_path(str(MJCF["sdh2"]))
    points = []
    for gap in (0.094, 0.034):
        data = hand_data(model, parallel(gap))
        points.append(np.mean([site_pose(model, data, name).translation for name in toml["pads"]], axis=0))
    travel = points[1] - points[0]
    np.testing.assert_allclose(travel[:2], 0.0, atol=EXACT)
    assert 0.003 < travel[2] < 0.007


def test_only_the_pads_reach_a_flat_rib() -> None:
    """A 34 mm rib held by parallel fingers: every other geom of the hand keeps clear of it."""
    toml = read_toml(HAND)
    posture = parallel(0.034)
    spec = mujoco.MjSpec.from_file(str(MJCF["sdh2"]))
    data = hand_data(spec.compile(), posture)
    height = site_pose(spec.compile(), data, "pad_1").translation[2]
    # 30 mm of rib above the contact: the height at which ribs are pinched, with as much below it as the tips reach.
    spec.worldbody.add_geom(
        name="rib",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.1, 0.017, 0.03],
        pos=[0.0, 0.0, height],
        contype=1,
        conaffinity=1,
    )
    model = spec.compile()
    data = hand_data(model, posture)
    rib = model.geom("rib").id
    between = np.zeros(6)
    for i in geom_ids(model, containing=""):
        name = model.geom(i).name
        if name == "rib":
            continue
        distance = mujoco.mj_geomDistance(model, data, i, rib, 1.0, between)
        if name in toml["pad_geoms"]:
            assert distance == pytest.approx(0.0, abs=2e-5), name
        else:
            assert distance > 0.0025, (name, distance)


@pytest.mark.parametrize("link", ["finger_1_distal", "thumb_distal", "finger_3_distal"])
def test_collision_geoms_of_a_distal_link_lie_within_the_tactile_arc(link: str) -> None:
    """No point in front of C is more than the radius away from it, so the tip sticks out no further than the pad."""
    model = mujoco.MjModel.from_xml_path(str(MJCF["sdh2"]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    centre = np.array([-0.012, 0.0, 0.0435])
    body = model.body(link).id
    # MuJoCo's distance to a ball that just touches the arc from the outside, from the pad's normal to the tip.
    for degrees in range(-30, 91, 10):
        direction = np.array([np.cos(np.deg2rad(degrees)), 0.0, np.sin(np.deg2rad(degrees))])
        probe = data.xpos[body] + data.xmat[body].reshape(3, 3) @ (centre + (0.025 + 0.004) * direction)
        spec = mujoco.MjSpec.from_file(str(MJCF["sdh2"]))
        spec.worldbody.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.004, 0, 0], pos=probe)
        with_probe = spec.compile()
        scratch = mujoco.MjData(with_probe)
        mujoco.mj_forward(with_probe, scratch)
        for i in range(with_probe.ngeom):
            geom = with_probe.geom(i)
            if with_probe.geom_bodyid[i] == body and geom.contype[0]:
                distance = mujoco.mj_geomDistance(with_probe, scratch, i, with_probe.geom("probe").id, 1.0, np.zeros(6))
                assert distance > -2e-5, (geom.name, degrees, distance)


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, i: int) -> float:
    """Largest z (m, towards the tips) of a geom: support function of its primitive."""
    z_row = data.geom_xmat[i].reshape(3, 3)[2]
    size = model.geom_size[i]
    kind = model.geom_type[i]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        reach = np.abs(z_row) @ size
    elif kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        reach = np.linalg.norm(z_row * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        reach = abs(z_row[2]) * size[1] + size[0]
    else:
        assert kind == mujoco.mjtGeom.mjGEOM_CYLINDER
        reach = abs(z_row[2]) * size[1] + size[0] * np.hypot(z_row[0], z_row[1])
    return float(data.geom_xpos[i][2] + reach)


def test_stowed_thumb_stays_behind_the_fingers() -> None:
    model = mujoco.MjModel.from_xml_path(str(MJCF["sdh2"]))
    data = hand_data(model, read_toml(HAND)["postures"]["open"])
    thumb = [i for i in range(model.ngeom) if model.geom(i).name.startswith(("thumb", "pad_2"))]
    assert len(thumb) > 10
    assert max(lowest_point(model, data, i) for i in thumb) < 0.13


@pytest.mark.parametrize("posture", ["open", "closed"])
def test_hand_is_free_of_itself_and_of_the_wrist(posture: str) -> None:
    """Over the whole range of A6 and A7 no geom of the hand meets links 0 to 5 or a finger it is not joined to."""
    model = arm_with_hand()
    toml = read_toml(HAND)
    data = mujoco.MjData(model)
    for name, angle in [*toml["locked"].items(), *zip(toml["joints"], toml["postures"][posture], strict=True)]:
        data.joint("hand/" + name).qpos[0] = angle
    hits = set()
    for a6 in np.deg2rad(np.linspace(-120, 120, 17)):
        for a7 in np.deg2rad(np.linspace(-175, 175, 15)):
            data.joint("A6").qpos[0], data.joint("A7").qpos[0] = a6, a7
            mujoco.mj_forward(model, data)
            for contact in data.contact:
                first, second = sorted(model.geom(int(g)).name for g in contact.geom)
                joined = abs(int(model.geom_bodyid[contact.geom[0]]) - int(model.geom_bodyid[contact.geom[1]])) <= 1
                pads = {"hand/pad_1", "hand/pad_3"} == {first, second}
                if "hand/" in first + second and not joined and not pads:
                    hits.add((first, second))
    assert not hits
