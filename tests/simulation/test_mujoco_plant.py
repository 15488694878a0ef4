"""The plant: honest torques, honest sensors, honest physics."""

import mujoco
import numpy as np
import pytest

from dyngrasp.signals import Command
from dyngrasp.simulation.mujoco_plant import SensorSettings
from dyngrasp.simulation.plant import ContactCategory, Plant, PlantDiverged

POSTURE = np.deg2rad([20.0, 30.0, 10.0, -80.0, 10.0, 60.0, 20.0])


def limp(scene):
    return Command(np.zeros(scene.arm_qpos.size), np.zeros(scene.gripper_qpos.size))


def energy(plant):
    """Kinetic and potential energy (J)."""
    model, data = plant.scene.model, plant._data
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return data.energy.sum()


def test_is_a_plant_and_tells_no_truth_to_controllers(scene, make_plant):
    plant = make_plant(scene)
    assert isinstance(plant, Plant)
    assert set(vars(plant.observe())) == {"t", "arm_position", "gripper_position", "pad_force"}


def test_torques_saturate_at_the_limits_of_the_motors(robot, gripper, scene, make_plant):
    asked, at_limit = make_plant(scene), make_plant(scene)
    sign = np.array([1.0, -1, 1, -1, 1, -1, 1])
    for _ in range(20):
        asked.step(Command(1e6 * sign, np.full(gripper.m, -1e6)))
        at_limit.step(Command(robot.limits.torque * sign, -gripper.torque))
    np.testing.assert_allclose(asked.applied.arm_torque, robot.limits.torque * sign, rtol=1e-12)
    np.testing.assert_allclose(asked.applied.gripper_torque, -gripper.torque, rtol=1e-12)
    np.testing.assert_array_equal(asked.state, at_limit.state)


def test_torques_below_the_limits_arrive_unchanged(scene, make_plant):
    plant = make_plant(scene)
    torque = np.array([30.0, -40.0, 5.0, 6.0, -2.0, 1.0, 0.5])
    plant.step(Command(torque, np.array([0.1, -0.2, 0.3, -0.4])))
    np.testing.assert_allclose(plant.applied.arm_torque, torque, rtol=1e-12)


def test_kinematics_and_weight_are_those_of_the_planners_models(robot, gripper, ideal_scene, make_plant):
    plant = make_plant(ideal_scene)
    truth = plant.truth()
    T_world_hand = robot.forward_kinematics(POSTURE) * gripper.T_flange_hand
    # Both read the same files; what differs is rounding.
    np.testing.assert_allclose(truth.T_world_hand.homogeneous, T_world_hand.homogeneous, atol=1e-9)
    G = T_world_hand.act(gripper.grasp_point(gripper.open_posture))
    np.testing.assert_allclose(truth.p_world_grasp_point, G, atol=1e-9)
    # The torques that hold the modelled arm still hold the simulated one, hand and all. Inertia is about 1 kg m², so
    # 1e-3 rad/s² stands for a milli-newton-metre.
    model, data = ideal_scene.model, plant._data
    data.ctrl[: robot.n] = robot.with_payload(gripper.payload(gripper.open_posture)).gravity_torque(POSTURE)
    mujoco.mj_forward(model, data)
    held = data.qfrc_actuator - data.qfrc_bias
    np.testing.assert_allclose(held[ideal_scene.arm_dof], 0.0, atol=1e-6)


def test_a_swinging_arm_gains_no_energy(fine_scene, scene, make_plant):
    losses = []
    for world in (fine_scene, scene):
        plant = make_plant(world)
        start = energy(plant)
        for _ in range(round(0.2 / world.settings.timestep)):
            plant.step(limp(world))
        assert np.abs(plant.truth().arm_velocity).max() > 1.0  # it did swing
        losses.append(start - energy(plant))
    ideal_loss, loss = losses
    # 17 J of potential energy are turned over. Without joint friction only the fingers lose some, by their damping of
    # 0.05 Nm s/rad at 0.3 rad/s: 1e-2 J; the rest is the integrator.
    assert 0.0 < ideal_loss < 0.05
    # Dry friction of about 1 Nm and damping of about 2 Nm s/rad on joints that turn a quarter of a radian.
    assert 0.3 < loss < 5.0


def test_a_part_in_the_air_falls_freely(scene, casting, make_plant):
    plant = make_plant(scene, position=(0.9, 0.9, 0.6))
    height = plant.truth().T_world_part.translation[2]
    for _ in range(100):
        plant.step(limp(scene))
    truth = plant.truth()
    # Semi-implicit Euler is off by g t dt / 2 = 0.5 mm.
    assert truth.T_world_part.translation[2] - height == pytest.approx(-0.5 * 9.81 * 0.1**2, abs=6e-4)
    np.testing.assert_allclose(truth.part_twist, [0, 0, -0.981, 0, 0, 0], atol=1e-9)
    assert not any(truth.contacts)


def test_a_part_on_the_ground_stays_where_it_is(scene, make_plant):
    plant = make_plant(scene)
    before = plant.truth().T_world_part
    for _ in range(300):
        plant.step(Command(np.array([0.0, -60, 0, 23, 0, 0, 0]), np.zeros(4)))
    after = plant.truth()
    # The contact yields by micrometres under the weight; it must neither creep nor rattle.
    np.testing.assert_allclose(after.T_world_part.homogeneous, before.homogeneous, atol=2e-5)
    assert np.flatnonzero(after.contacts).tolist() == [ContactCategory.PART_GROUND]
    np.testing.assert_array_equal(after.pad_force, 0.0)


def test_same_commands_give_the_same_states_and_readings(scene, make_plant):
    def run(seed):
        plant = make_plant(scene, sensors=SensorSettings(encoder_noise=1e-4, seed=seed))
        rng = np.random.default_rng(3)
        readings = []
        for _ in range(200):
            readings.append(plant.observe().arm_position)
            plant.step(Command(rng.normal(0, 30, 7), rng.normal(0, 0.3, 4)))
        return np.array(readings), plant.state

    (first, state), (again, state_again), (other, state_other) = run(5), run(5), run(6)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(state, state_again)
    # Noise of the sensors does not act on the plant.
    np.testing.assert_array_equal(state, state_other)
    assert not np.array_equal(first, other)


def test_encoders_quantise_and_scatter_as_set(scene, make_plant):
    step = 1e-3
    coarse = make_plant(scene, sensors=SensorSettings(encoder_step=step)).observe().arm_position
    np.testing.assert_allclose(coarse / step, np.round(coarse / step), atol=1e-9)
    np.testing.assert_allclose(coarse, POSTURE, atol=step / 2 + 1e-12)
    plant = make_plant(scene, sensors=SensorSettings(encoder_noise=1e-3, seed=1))
    np.testing.assert_array_equal(plant.observe().arm_position, plant.observe().arm_position)
    errors = []
    for _ in range(100):
        truth = plant.truth().arm_position
        errors.append(plant.observe().arm_position - truth)
        plant.step(limp(scene))
    # 700 samples: the standard deviation is known to 3 %; five times that is never reached by chance.
    assert np.std(errors) == pytest.approx(1e-3, rel=0.15)


def test_an_exact_sensor_reads_the_true_state(scene, make_plant):
    plant = make_plant(scene)
    np.testing.assert_array_equal(plant.observe().arm_position, POSTURE)
    plant.step(limp(scene))
    np.testing.assert_array_equal(plant.observe().arm_position, plant.truth().arm_position)


def test_a_torque_that_is_no_number_is_refused(scene, make_plant):
    plant = make_plant(scene)
    with pytest.raises(PlantDiverged, match="not finite"):
        plant.step(Command(np.full(7, np.nan), np.zeros(4)))


def test_an_unstable_simulation_is_reported_and_not_restarted(scene, make_plant, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plant = make_plant(scene)
    plant._data.qvel[scene.arm_dof] = 1e12
    with pytest.raises(PlantDiverged, match="simulation failed at"):
        step_often(plant)
    assert list(tmp_path.iterdir()) == []  # no log file in the user's folder


def step_often(plant):
    for _ in range(10):
        plant.step(limp(plant.scene))
