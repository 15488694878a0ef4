"""Each criterion passes on a good record and fails, by its own name, on one that breaks it and nothing else."""

import itertools
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.experiments.metrics import judge
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.simulation.plant import ContactCategory
from dyngrasp.trajectory import GraspPlan, Trajectory

RATE, SPAN = 100, 3.0
T_1, T_2 = 1.0, 1.5


@pytest.fixture(scope="module")
def task():
    return GraspTask(
        load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"), np.deg2rad([0, 30, 0, -80, 0, 70, 0])
    )


@pytest.fixture(scope="module")
def plan(task):
    """All joints at constant speed, the hand closed on the part: easy to say what is right."""
    w = np.full(7, 0.1)
    ends = np.array([0.0, T_1, T_2, SPAN])
    closed = task.closed_posture(task.grasp_object.grasps[0])

    def phase(start, end):
        t = np.linspace(start, end, 11)
        return Trajectory(end - start, task.place + np.outer(t - SPAN, w), np.tile(w, (11, 1)), np.zeros((11, 7)))

    def hand(start, end):
        still = np.zeros((11, 4))
        return Trajectory(end - start, np.tile(closed, (11, 1)), still, still)

    spans = list(itertools.pairwise(ends))
    return GraspPlan(
        (phase(*spans[0]), phase(*spans[1]), phase(*spans[2])),
        (hand(*spans[0]), hand(*spans[1]), hand(*spans[2])),
        0.0,
        task.robot.joint_names,
        task.gripper.joint_names,
    )


@pytest.fixture(scope="module")
def perfect(task, plan):
    """The record of an episode in which everything went as planned."""
    t = np.arange(0, SPAN + 0.5, 1 / RATE)
    grasp, robot, gripper = task.grasp_object.grasps[0], task.robot, task.gripper
    samples = [plan.sample(x) for x in t]
    q, w = (np.array([getattr(s.arm, name) for s in samples]) for name in ("position", "velocity"))
    posture = np.array([s.gripper.position for s in samples])
    T_hand_grasp = gripper.T_hand_grasp(posture[0])
    hands = [robot.forward_kinematics(x) * gripper.T_flange_hand for x in q]
    grasped = int(T_2 * RATE)
    parts = [hands[max(k, grasped)] * T_hand_grasp * grasp.T_object_grasp.inverse() for k in range(len(t))]

    def quats(poses):
        return np.array([pin.Quaternion(T.rotation).coeffs()[[3, 0, 1, 2]] for T in poses])

    contacts = np.zeros((len(t), len(ContactCategory)), dtype=bool)
    contacts[:grasped, ContactCategory.PART_GROUND] = True
    contacts[grasped - 2 :, ContactCategory.PADS_PART] = True
    zero, torque = np.zeros_like(posture), np.zeros_like(q)
    return EpisodeRecord(
        plan.arm_joints,
        plan.gripper_joints,
        t=t,
        phase=np.array([plan.phase_at(x) for x in t]),
        arm_planned=q,
        arm_planned_velocity=w,
        arm_measured=q,
        arm_filtered_velocity=w,
        arm_velocity=w,
        arm_torque_commanded=torque,
        arm_torque_applied=torque,
        gripper_planned=posture,
        gripper_measured=posture,
        gripper_torque_commanded=zero,
        gripper_torque_applied=zero,
        part_position=np.array([T.translation for T in parts]),
        part_quat_wxyz=quats(parts),
        support_position=np.zeros((len(t), 3)),
        hand_position=np.array([T.translation for T in hands]),
        hand_quat_wxyz=quats(hands),
        grasp_point=np.array([T.act(T_hand_grasp.translation) for T in hands]),
        pad_force=np.where(np.arange(len(t))[:, None] >= grasped - 2, 12.0, 0.0) * np.ones(2),
        contacts=contacts,
        scene_state=q,
    )


def changed(record, name, change):
    values = np.array(getattr(record, name))
    change(values, record.t)
    return replace(record, **{name: values})


def shift(after, offset, before=np.inf):
    def change(values, t):
        values[(t >= after) & (t < before)] += offset

    return change


def touch(category, start, end, value=True):
    def change(values, t):
        values[(t >= start) & (t < end), category] = value

    return change


def turn(after, degrees):
    def change(values, t):
        for k in np.flatnonzero(t >= after):
            w, x, y, z = values[k]
            turned = pin.Quaternion(w, x, y, z) * pin.Quaternion(pin.exp3(np.array([0, 0, np.deg2rad(degrees)])))
            values[k] = turned.coeffs()[[3, 0, 1, 2]]

    return change


def stop(values, t):
    values[(t > 1.2) & (t < 1.25)] = 1e-4


def test_a_perfect_episode_passes_everything(task, plan, perfect):
    outcome = judge(plan, perfect, task, task.grasp_object.grasps[0])
    assert outcome.success, outcome.cause
    assert outcome.cause == ""
    summary = outcome.summary()
    assert summary["collisions"] == 0
    for name in ("undisturbed_mm", "slip_mm", "slip_deg", "place_mm", "place_deg"):
        assert summary[name] == pytest.approx(0.0, abs=1e-4), name
    # 0.1 rad/s, and A4 is the slowest joint: 75 deg/s.
    assert summary["min_speed_ratio"] == pytest.approx(0.1 / np.deg2rad(75), rel=1e-6)
    assert outcome.worst["velocity"] == pytest.approx(0.1 / np.deg2rad(75), rel=1e-6)
    assert set(summary["passed"]) == {"clear", "undisturbed", "lifted", "held", "slip", "placed", "limits", "moving"}


@pytest.mark.parametrize(
    ("criterion", "array", "change"),
    [
        ("undisturbed", "part_position", shift(0.8, np.array([0.0031, 0, 0]), before=T_2 - 0.015)),
        ("clear", "contacts", touch(ContactCategory.OTHER_ROBOT_PART, 0.5, 0.6)),
        ("clear", "contacts", touch(ContactCategory.ROBOT_GROUND, 2.5, 2.6)),
        ("clear", "contacts", touch(ContactCategory.ROBOT_ROBOT, 2.5, 2.6)),
        ("lifted", "contacts", touch(ContactCategory.PART_GROUND, T_2, T_2 + 0.11)),
        ("held", "contacts", touch(ContactCategory.PART_GROUND, 2.5, 2.6)),
        ("held", "pad_force", shift(3.2, np.array([-12.0, 0.0]))),
        ("slip", "part_position", shift(2.0, np.array([0, 0.0051, 0]), before=2.5)),
        ("placed", "part_position", shift(T_2, np.array([0, 0, -0.0101]))),
        ("placed", "part_quat_wxyz", turn(T_2 + 0.1, 5.1)),
        ("limits", "arm_torque_commanded", shift(2.0, np.array([0, 0, 0, 0, 0, 0, 40.0]))),
        ("limits", "arm_velocity", shift(2.0, np.array([0, 0, 0, 1.3, 0, 0, 0]), before=2.1)),
        ("limits", "arm_measured", shift(2.0, np.array([0, 0, 0, 0, 0, 1.2, 0]), before=2.1)),
        ("moving", "arm_velocity", stop),
    ],
)
def test_each_criterion_fails_alone(task, plan, perfect, criterion, array, change):
    outcome = judge(plan, changed(perfect, array, change), task, task.grasp_object.grasps[0])
    failed = {c.name for c in outcome.criteria if not c.passed}
    # What is on the ground after the grasp is not held either.
    assert failed - {"held"} == {criterion} - {"held"}
    assert criterion in failed
    assert outcome.cause.startswith(criterion)


def test_turning_in_the_hand_is_slip(task, plan, perfect):
    grasp = task.grasp_object.grasps[0]
    turned = changed(perfect, "part_quat_wxyz", turn(2.0, 5.2))
    outcome = judge(plan, turned, task, grasp)
    assert outcome.summary()["slip_deg"] == pytest.approx(5.2, abs=1e-6)
    assert outcome.cause.startswith("slip")


def test_the_cause_is_what_came_first(task, plan, perfect):
    late = changed(perfect, "contacts", touch(ContactCategory.ROBOT_ROBOT, 3.0, 3.1))
    both = changed(late, "part_position", shift(0.8, np.array([0.01, 0, 0]), before=T_2 - 0.015))
    outcome = judge(plan, both, task, task.grasp_object.grasps[0])
    assert outcome.cause.startswith("undisturbed: the part was pushed 10.0 mm")


def test_a_lasting_touch_is_one_collision(task, plan, perfect):
    once = changed(perfect, "contacts", touch(ContactCategory.ROBOT_ROBOT, 2.0, 2.9))
    twice = changed(once, "contacts", touch(ContactCategory.ROBOT_ROBOT, 2.4, 2.5, value=False))
    grasp = task.grasp_object.grasps[0]
    assert [judge(plan, r, task, grasp).summary()["collisions"] for r in (once, twice)] == [1, 2]
