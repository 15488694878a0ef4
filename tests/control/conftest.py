"""Models, worlds and motions that the tests of the controllers share."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.catalogue import load_gripper, load_object, load_robot


@pytest.fixture(scope="session")
def robot():
    return load_robot("iiwa14")


@pytest.fixture(scope="session")
def gripper():
    return load_gripper("sdh2")


@pytest.fixture(scope="session")
def casting():
    return load_object("casting")


@pytest.fixture(scope="session")
def far_away(casting):
    """Where the part is out of the way."""
    return pin.SE3(np.eye(3), np.array([0.9, 0.9, casting.rest_height]))
