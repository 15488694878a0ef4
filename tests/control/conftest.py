"""Models, worlds and motions that the tests of the controllers share."""

import numpy as np
import pinocchio as pin
import pytest


@pytest.fixture(scope="session")
def far_away(casting):
    """Where the part is out of the way."""
    return pin.SE3(np.eye(3), np.array([0.9, 0.9, casting.rest_height]))
