"""Position before contact, force after it, and never more than the hand can give."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.control.gripper_control import GripperController, GripperControlSettings
from dyngrasp.signals import JointState, Observation
from dyngrasp.trajectory import PlanSample

UPRIGHT = np.array([0.0, 0.0, -9.81])  # the palm looks down: its accelerometer reads −g along its own z


@pytest.fixture
def closed(gripper, casting):
    return gripper.posture_for(casting.grasps[0].width)


def command(controller, gripper, posture, t=0.0, phase="grasp", force=(0.0, 0.0), plan=None, specific_force=UPRIGHT):
    rest = np.zeros(gripper.m)
    observation = Observation(t, np.zeros(7), posture, np.array(force))
    arm = JointState(t, np.zeros(7), np.zeros(7), np.zeros(7))
    planned = JointState(t, posture if plan is None else plan, rest, rest)
    return controller.command(observation, PlanSample(phase, arm, planned), specific_force)


def pad_forces(gripper, posture, torque):
    """(2,) force of each pad along its closing direction that these joint torques balance (N)."""
    model, data = gripper.pin_model, gripper.pin_model.createData()
    forces = []
    for i, (pad, side) in enumerate(zip(gripper.pad_ids, (-1.0, 1.0), strict=True)):
        h = 1e-6
        finger = slice(2 * i, 2 * i + 2)
        gradient = np.zeros(gripper.m)
        for j in range(gripper.m):
            q = [np.array(posture), np.array(posture)]
            q[0][j] += h
            q[1][j] -= h
            ends = []
            for posture_j in q:
                pin.framesForwardKinematics(model, data, gripper.full_configuration(posture_j))
                ends.append(pin.SE3(data.oMf[pad]))
            # The material point of the pad that is foremost at this posture.
            foremost = ends[0].actInv(ends[0].translation + gripper.pad_radius * side * gripper.closing_axis)
            gradient[j] = side * gripper.closing_axis @ (ends[0].act(foremost) - ends[1].act(foremost)) / (2 * h)
        forces.append(torque[finger] @ gradient[finger] / (gradient[finger] @ gradient[finger]))
    return np.array(forces)


def test_holds_the_fingers_against_their_weight(gripper, closed):
    controller = GripperController(gripper, 1e-3)
    sideways = np.array([0.0, 9.81, 0.0])
    torque = command(controller, gripper, closed, phase="approach", specific_force=sideways)
    model = pin.Model(gripper.pin_model)
    model.gravity.linear = -sideways
    weight = pin.computeGeneralizedGravity(model, model.createData(), gripper.full_configuration(closed))
    assert np.abs(torque).max() > 0.1
    np.testing.assert_allclose(torque, weight[gripper.planned_indices], atol=1e-9)


def test_squeeze_ramps_up_once_both_pads_feel_the_part(gripper, closed):
    settings = GripperControlSettings(over_close=0.0)
    controller = GripperController(gripper, 1e-3, settings=settings)
    still = command(controller, gripper, closed)
    assert not controller.squeezing
    one = command(controller, gripper, closed, t=0.010, force=(2.0, 0.0))
    assert not controller.squeezing
    np.testing.assert_allclose(one, still, atol=1e-9)
    levels = []
    for k in range(12):
        torque = command(controller, gripper, closed, t=0.020 + 0.01 * k, force=(2.0, 2.0))
        levels.append(np.max(np.abs(torque - still) / gripper.torque))
    expected = settings.force_fraction * np.minimum(np.arange(12) * 0.01 / settings.ramp, 1.0)
    np.testing.assert_allclose(levels, expected, atol=1e-9)


@pytest.mark.parametrize("tilt", [-0.7, 0.4])
def test_one_pad_presses_more_where_the_part_would_slide_sideways(gripper, closed, tilt):
    """Of a hand tilted about x the upper pad is relieved by what the lower one carries more; together it is m g."""
    mass, g = 0.6, 9.81
    tilted = g * np.array([0.0, np.sin(tilt), -np.cos(tilt)])
    forces = []
    for held_mass in (0.0, mass):
        controller = GripperController(gripper, 1e-3, held_mass, GripperControlSettings(over_close=0.0))
        weight = command(controller, gripper, closed, phase="approach", specific_force=tilted)
        for t in (0.0, 1.0):
            torque = command(controller, gripper, closed, t=t, force=(2.0, 2.0), specific_force=tilted)
        forces.append(pad_forces(gripper, closed, torque - weight))
    empty, loaded = forces
    # The first pad presses against the closing axis, y; the part's reaction to gravity points along `tilted`.
    change = mass * tilted[1] / 2
    np.testing.assert_allclose(loaded - empty, [-change, change], rtol=1e-4)


def test_squeeze_presses_both_pads_alike(gripper, closed):
    controller = GripperController(gripper, 1e-3, settings=GripperControlSettings(over_close=0.0))
    weight = command(controller, gripper, closed, t=0.0, phase="approach")
    command(controller, gripper, closed, t=0.0, force=(2.0, 2.0))
    squeeze = command(controller, gripper, closed, t=1.0, force=(2.0, 2.0)) - weight
    left, right = pad_forces(gripper, closed, squeeze)
    assert left == pytest.approx(right, rel=1e-6)
    # 0.8 of 2.1 Nm over the 0.13 m from joint to pad.
    assert left == pytest.approx(0.8 * 2.1 / 0.13, rel=0.03)
    assert left < gripper.pinch_force


def test_first_touch_closes_further_by_what_was_set(gripper, closed):
    settings = GripperControlSettings(force_fraction=1e-9)
    controller = GripperController(gripper, 1e-3, settings=settings)
    step = controller._over_closing(closed)
    assert gripper.aperture(closed) - gripper.aperture(closed + step) == pytest.approx(
        2 * settings.over_close, rel=0.01
    )
    before = command(controller, gripper, closed)
    for k in range(1, 200):
        after = command(controller, gripper, closed, t=k * 1e-3, force=(2.0, 0.0))
    np.testing.assert_allclose(
        (after - before)[[0, 2]], (controller._inertia * settings.bandwidth**2 * step)[[0, 2]], rtol=1e-3
    )


def test_squeezes_without_touch_once_the_planned_closing_has_ended(gripper, closed):
    controller = GripperController(gripper, 1e-3)
    command(controller, gripper, closed, phase="grasp")
    assert not controller.squeezing
    command(controller, gripper, closed, t=0.001, phase="deliver")
    assert controller.squeezing


def test_never_passes_the_torque_limits(gripper, closed):
    controller = GripperController(gripper, 1e-3)
    for k in range(200):
        far = closed + 0.8 if k % 40 < 20 else closed - 0.8
        torque = command(controller, gripper, closed, t=k * 1e-3, phase="deliver", plan=far, force=(9.0, 9.0))
        assert (np.abs(torque) <= gripper.torque).all()
    assert (np.abs(torque) == gripper.torque).any()
