"""The arm, the hand and the part that come with the package."""

import pytest
from hypothesis import settings

from dyngrasp.models.catalogue import load_gripper, load_object, load_robot

# The first call of compiled code may wait for the compiler.
settings.register_profile("compiled", deadline=None)
settings.load_profile("compiled")


@pytest.fixture(scope="session")
def robot():
    return load_robot("iiwa14")


@pytest.fixture(scope="session")
def gripper():
    return load_gripper("sdh2")


@pytest.fixture(scope="session")
def casting():
    return load_object("casting")
