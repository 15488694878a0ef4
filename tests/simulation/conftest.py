"""Worlds and plants of the arm, the hand and the part that come with the package."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import SceneSettings, build_scene
from dyngrasp.simulation.variation import PlantVariation


@pytest.fixture(scope="session")
def ideal(robot):
    return PlantVariation.ideal(robot.n, friction=0.75, torsional_friction=0.0094)


@pytest.fixture(scope="session")
def scene(robot, gripper, casting):
    """The nominal world."""
    return build_scene(robot, gripper, casting)


@pytest.fixture(scope="session")
def ideal_scene(robot, gripper, casting, ideal):
    """The world as the models have it: no joint friction."""
    return build_scene(robot, gripper, casting, ideal)


@pytest.fixture(scope="session")
def fine_scene(robot, gripper, casting, ideal):
    """The same at 8 kHz, where errors of the integrator are small."""
    return build_scene(robot, gripper, casting, ideal, SceneSettings(timestep=125e-6))


@pytest.fixture
def make_plant(gripper, casting):
    """A plant with the arm in a posture away from everything and the part on the ground."""

    def make(scene, *, position=(0.9, 0.9, None), **kwargs):
        x, y, z = position
        T_world_part = pin.SE3(np.eye(3), np.array([x, y, casting.rest_height if z is None else z]))
        return MujocoPlant(scene, POSTURE, gripper.open_posture, T_world_part, **kwargs)

    return make


POSTURE = np.deg2rad([20.0, 30.0, 10.0, -80.0, 10.0, 60.0, 20.0])
