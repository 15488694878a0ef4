"""The conveyor: it keeps its speed, and friction is all that carries the part."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Command
from dyngrasp.simulation.conveyor import Conveyor, standing_on
from dyngrasp.simulation.plant import ContactCategory
from dyngrasp.simulation.scene import SceneSettings, build_scene

VELOCITY = np.array([0.03, -0.08])
START = np.array([0.9, 0.9])


@pytest.fixture(scope="module")
def conveyor():
    return Conveyor(VELOCITY, START)


def hold(robot, plant):
    """The arm's weight is borne; where it goes does not matter here, but it must not fall on anything."""
    plant.step(Command(robot.gravity_torque(plant.truth().arm_position), np.zeros(plant.scene.gripper_qpos.size)))


@pytest.fixture(scope="module")
def placed(casting, conveyor):
    return standing_on(conveyor, pin.SE3(np.eye(3), np.array([*START, casting.rest_height]))).translation


def test_a_part_rides_along_at_the_conveyors_speed(robot, gripper, casting, conveyor, ideal, make_plant, placed):
    plant = make_plant(build_scene(robot, gripper, casting, ideal, conveyor=conveyor), position=tuple(placed))
    for _ in range(300):
        hold(robot, plant)
    truth = plant.truth()
    travelled = np.append(0.3 * VELOCITY, 0.0)
    # The servo has nothing to push against but the start's rounding; contacts give way by fractions of a micrometre.
    np.testing.assert_allclose(truth.p_world_support, travelled, atol=1e-6)
    np.testing.assert_allclose(truth.T_world_part.translation - placed, travelled, atol=5e-6)
    np.testing.assert_allclose(truth.part_twist[:2], VELOCITY, atol=1e-5)
    assert truth.contacts[ContactCategory.PART_GROUND]


def test_a_part_put_down_at_rest_is_dragged_by_friction_alone(robot, gripper, casting, ideal, make_plant, placed):
    slippery = SceneSettings(ground_friction=0.02)
    fast = Conveyor(np.array([0.4, 0.0]), START)
    scene = build_scene(robot, gripper, casting, ideal, slippery, conveyor=fast)
    plant = make_plant(scene, position=tuple(placed))
    plant._data.qvel[scene.part_dof : scene.part_dof + 6] = 0.0
    mujoco.mj_forward(scene.model, plant._data)
    for _ in range(200):
        hold(robot, plant)
    # Coulomb: μ g for 0.2 s; the cone is soft by 1/impratio.
    assert plant.truth().part_twist[0] == pytest.approx(0.02 * 9.81 * 0.2, rel=0.1)
    # The plate does not notice: its servo is stiff.
    assert plant.truth().p_world_support[0] == pytest.approx(0.08, abs=1e-4)


def test_a_part_set_beside_the_plate_stays_behind(robot, gripper, casting, conveyor, ideal, make_plant):
    scene = build_scene(robot, gripper, casting, ideal, conveyor=conveyor)
    plant = make_plant(scene, position=(1.6, -0.9, None))
    plant._data.qvel[scene.part_dof : scene.part_dof + 6] = 0.0
    for _ in range(200):
        hold(robot, plant)
    np.testing.assert_allclose(plant.truth().T_world_part.translation[:2], [1.6, -0.9], atol=1e-5)


def test_without_a_conveyor_nothing_moves_under_the_part(scene, make_plant):
    plant = make_plant(scene)
    assert scene.conveyor is None
    np.testing.assert_array_equal(plant.truth().p_world_support, 0.0)


@pytest.mark.parametrize("bad", [{"velocity": np.array([np.nan, 0.0])}, {"width": 0.0}, {"height": -1.0}])
def test_bad_conveyors_are_refused(bad):
    with pytest.raises(InvalidProblem):
        Conveyor(**{"velocity": VELOCITY, "centre": START, **bad})


def test_a_part_that_is_moved_away_rides_from_rest_to_rest(robot, gripper, casting, ideal, make_plant, placed):
    # 30 mm within 0.3 s: at 2.1 m/s² friction, of 0.5 g, still carries it.
    moves = Conveyor(np.array([0.06, 0.08]), START, run=(0.05, 0.35))
    plant = make_plant(build_scene(robot, gripper, casting, ideal, conveyor=moves), position=tuple(placed))
    way = []
    for _ in range(450):
        hold(robot, plant)
        truth = plant.truth()
        way.append([truth.t, *(truth.T_world_part.translation - placed)[:2], *truth.part_twist[:2]])
    t, position, speed = np.array(way)[:, 0], np.array(way)[:, 1:3], np.array(way)[:, 3:]
    assert np.abs(position[t < 0.05]).max() < 1e-5
    np.testing.assert_allclose(position[t > 0.36], np.tile(0.3 * moves.velocity, ((t > 0.36).sum(), 1)), atol=1e-4)
    assert np.abs(speed[t > 0.37]).max() < 1e-3
    # Twice the mean in the middle.
    np.testing.assert_allclose(speed[np.abs(t - 0.2).argmin()], 2.0 * moves.velocity, atol=2e-3)


@pytest.mark.parametrize("run", [(1.0, 1.0), (2.0, 1.0), (np.nan, 1.0)])
def test_a_conveyor_that_stops_before_it_starts_is_refused(run):
    with pytest.raises(InvalidProblem):
        Conveyor(VELOCITY, START, run=run)
