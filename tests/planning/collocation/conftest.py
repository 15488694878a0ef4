"""Phases of the iiwa with the SDH2, and random phases without any model."""

import numpy as np
import pytest

from dyngrasp.models.catalogue import load_gripper, load_robot
from dyngrasp.planning.collocation.ipopt import IpoptSolver
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.problem import PhaseProblem


@pytest.fixture(scope="session")
def iiwa():
    return load_robot("iiwa14")


@pytest.fixture(scope="session")
def sdh2():
    return load_gripper("sdh2")


@pytest.fixture(scope="session")
def solver():
    """One for the session, as functions of a structure are built once."""
    return IpoptSolver()


@pytest.fixture(scope="module")
def structured():
    return StructuredSolver()


@pytest.fixture
def make_problem():
    def make(seed: int = 0, joints: int = 7, **changes) -> PhaseProblem:
        random = np.random.default_rng(seed)
        phase = {
            "name": "test",
            "start_position": random.uniform(-1, 1, joints),
            "start_velocity": random.uniform(-0.3, 0.3, joints),
            "end_position": random.uniform(-1, 1, joints),
            "end_velocity": random.uniform(-0.3, 0.3, joints),
            "position_lower": np.full(joints, -3.0),
            "position_upper": np.full(joints, 3.0),
            "velocity_limit": np.full(joints, 1.5),
            "acceleration_limit": np.full(joints, np.inf),
        }
        return PhaseProblem(**(phase | changes))

    return make
