"""The iiwa with the SDH2 and the casting, and one plan of the product's own planner."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.collocation.planner import CollocationPlanner
from dyngrasp.planning.grasp_targets import grasp_targets
from dyngrasp.planning.grasp_task import GraspTask

# Start and target of the experiments (deg).
START = np.deg2rad([55, 39.5, -6.6, -22, -36.3, 110.6, 134])
PLACE = np.deg2rad([-45, 37.3, 0, -69.9, 0, 72.8, 45])


@pytest.fixture(scope="session")
def q_start():
    return START


@pytest.fixture(scope="session")
def task():
    return GraspTask(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"), PLACE)


@pytest.fixture(scope="session")
def T_world_object(task):
    return pin.SE3(pin.utils.rotate("z", 0.6), np.array([0.65, 0.05, task.grasp_object.rest_height]))


@pytest.fixture(scope="session")
def targets(task, T_world_object):
    return grasp_targets(T_world_object, task, START)


@pytest.fixture(scope="session")
def plan(task, targets):
    """A plan that passes the audit; audits and clearances are tested with what is made of it."""
    return CollocationPlanner(task).plan(START, targets).require()
