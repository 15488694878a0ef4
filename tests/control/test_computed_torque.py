"""Tracking of the arm in the simulated plant, with and without friction that the controller does not know."""

import numpy as np
import pytest

from dyngrasp.control.computed_torque import ComputedTorque, ComputedTorqueSettings
from dyngrasp.control.grasp_controller import GraspController
from dyngrasp.control.gripper_control import GripperController
from dyngrasp.signals import JointState, Observation
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import SceneSettings, build_scene
from dyngrasp.simulation.variation import PlantVariation
from dyngrasp.trajectory import PlanSample

POSTURE = np.deg2rad([20.0, 30.0, 10.0, -80.0, 10.0, 60.0, 20.0])
OMEGA = 2 * np.pi * np.array([0.40, 0.45, 0.50, 0.55, 0.60, 0.65, 0.70])
RUBBER = {"friction": 0.75, "torsional_friction": 0.0094}


def swing(t, gripper, amplitude=0.25):
    """Every joint at a frequency of its own, from rest."""
    rest = np.zeros(gripper.m)
    return PlanSample(
        "approach",
        JointState(
            t,
            POSTURE + amplitude * (1 - np.cos(OMEGA * t)) / 2,
            amplitude * OMEGA * np.sin(OMEGA * t) / 2,
            amplitude * OMEGA**2 * np.cos(OMEGA * t) / 2,
        ),
        JointState(t, gripper.open_posture, rest, rest),
    )


@pytest.fixture
def track(robot, gripper, casting, far_away):
    def run(variation, *, dt=1e-3, seconds=2.0, settings=None):
        scene = build_scene(robot, gripper, casting, variation, SceneSettings(timestep=dt))
        plant = MujocoPlant(scene, POSTURE, gripper.open_posture, far_away)
        empty = robot.with_payload(gripper.payload(gripper.open_posture))
        arm = ComputedTorque(empty, empty, dt, settings)
        controller = GraspController(robot, gripper, arm, GripperController(gripper, dt))
        errors = []
        for k in range(round(seconds / dt)):
            sample = swing(k * dt, gripper)
            observed = plant.observe()
            errors.append(sample.arm.position - observed.arm_position)
            plant.step(controller.command(observed, sample))
        return np.abs(errors)

    return run


def test_tracks_a_sine_when_the_model_is_exact(track, robot):
    errors = track(PlantVariation.ideal(robot.n, **RUBBER))
    # Left: the step of acceleration at t = 0, where the fingers, which the model takes as rigid, give a little.
    assert errors.max() < 2e-4
    assert errors[1000:].max() < 3e-5


def test_eight_kilohertz_is_no_worse(track, robot):
    errors = track(PlantVariation.ideal(robot.n, **RUBBER), dt=125e-6, seconds=0.5)
    assert errors.max() < 2e-4


def test_friction_and_wrong_inertia_leave_less_than_the_grasp_allows(track, robot):
    rng = np.random.default_rng(5)
    errors = track(PlantVariation.draw(rng, robot.n), seconds=2.5)
    # 3 mrad at 0.3 m from the wrist is 1 mm at the pads. The first half second is for learning the friction.
    assert errors[500:].max() < 3e-3
    assert errors.max() < 0.01


def test_learnt_friction_pays(track, robot):
    nominal = PlantVariation.nominal(robot.n, **RUBBER)
    learning = track(nominal, seconds=2.5)
    plain = track(nominal, seconds=2.5, settings=ComputedTorqueSettings(friction_adaptation=0.0))
    rms = [np.sqrt((e[1000:] ** 2).mean()) for e in (learning, plain)]
    # Measured: a factor of 4 to 6.
    assert rms[0] < rms[1] / 2


def test_never_asks_for_more_than_the_motors_give_and_does_not_wind_up(robot, gripper):
    controller = ComputedTorque(robot, robot, 1e-3)
    rest = np.zeros(robot.n)
    hand = JointState(0.0, gripper.open_posture, np.zeros(gripper.m), np.zeros(gripper.m))

    def ask(target, k):
        observation = Observation(k * 1e-3, POSTURE, gripper.open_posture, np.zeros(2))
        return controller.command(observation, PlanSample("approach", JointState(k * 1e-3, target, rest, rest), hand))

    # A target 1 rad away while the arm is stuck: every joint saturates and stays within its limit.
    for k in range(2000):
        torque = ask(POSTURE + 1.0, k)
    assert (np.abs(torque) <= robot.limits.torque).all()
    assert (np.abs(torque) == robot.limits.torque).sum() >= 5
    # An integrator that had followed 2 s of 1 rad would hold 18 000 rad/s², tens of thousands of Nm. This one stops at
    # the limit; what it took while the neighbours moved on may exceed that by their coupling.
    carried = robot.mass_matrix(POSTURE) @ controller._integral
    assert (np.abs(carried) < 2 * robot.limits.torque).all()


def test_payload_takes_over_at_the_grasp_without_a_jump(robot, gripper):
    loaded = robot.with_payload(gripper.payload(gripper.open_posture))
    controller = ComputedTorque(robot, loaded, 1e-3)
    rest = np.zeros(robot.n)
    hand = JointState(0.0, gripper.open_posture, np.zeros(gripper.m), np.zeros(gripper.m))
    torques = []
    for k in range(200):
        phase = "grasp" if k < 100 else "deliver"
        sample = PlanSample(phase, JointState(k * 1e-3, POSTURE, rest, rest), hand)
        torques.append(controller.command(Observation(k * 1e-3, POSTURE, gripper.open_posture, np.zeros(2)), sample))
    torques = np.array(torques)
    np.testing.assert_allclose(torques[99], robot.gravity_torque(POSTURE), atol=1e-9)
    np.testing.assert_allclose(torques[-1], loaded.gravity_torque(POSTURE), atol=1e-9)
    step = np.abs(np.diff(torques, axis=0)).max()
    assert step < 0.02 * np.abs(torques[-1] - torques[0]).max()
