"""What a phase problem and its rows refuse, and in which words."""

import casadi as ca
import numpy as np
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.planning.problem import NodeConstraint, PhaseProblem

N = 10


def problem(**changes) -> PhaseProblem:
    """Two joints from 0 to 1 rad within ±2 rad and 3 rad/s."""
    q, one = np.zeros(2), np.ones(2)
    given = {
        "name": "reach",
        "start_position": q,
        "start_velocity": q,
        "end_position": one,
        "end_velocity": q,
        "position_lower": -2 * one,
        "position_upper": 2 * one,
        "velocity_limit": 3 * one,
        "acceleration_limit": np.inf * one,
        "intervals": N,
    }
    return PhaseProblem(**(given | changes))


def row(joints: int = 2, **changes) -> NodeConstraint:
    """The sum of the positions and of one parameter, at most 5."""
    q, v, p = ca.SX.sym("q", joints), ca.SX.sym("v", joints), ca.SX.sym("p", 1)
    function = ca.Function("row", [q, v, p], [ca.sum1(q) + p])
    given = {
        "function": function,
        "parameters": np.zeros((N + 1, 1)),
        "lower": np.array([-np.inf]),
        "upper": np.array([5.0]),
        "scale": np.ones(1),
    }
    return NodeConstraint("row", **(given | changes))


def test_arrays_are_kept_read_only():
    position = np.zeros(2)
    kept = problem(start_position=position, constraints=[row()])
    position[0] = 1.0
    assert kept.start_position[0] == 0.0
    assert isinstance(kept.constraints, tuple)
    with pytest.raises(ValueError, match="read-only"):
        kept.start_position[0] = 1.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"start_position": [0.0, 2.1]}, r"joint 2 of the start state is at 2.1000 rad .* -2.0000 to 2.0000 rad"),
        ({"end_position": [-2.1, 0.0]}, "joint 1 of the end state is at -2.1000 rad"),
        (
            {"end_velocity": [0.0, -3.1]},
            "joint 2 of the end state is at 1.0000 rad with -3.1000 rad/s, .* 3.0000 rad/s",
        ),
        ({"start_velocity": [np.nan, 0.0]}, "joint 1 of the start state .* nan"),
        ({"end_position": [0.0, np.nan]}, "joint 2 of the end state is at nan"),
        ({"end_position": [np.inf, 0.0], "position_upper": [np.inf, 2.0]}, "joint 1 of the end state is at inf"),
        ({"start_velocity": [np.inf, 0.0], "velocity_limit": [np.inf, 3.0]}, "joint 1 of the start state"),
        ({"position_lower": [np.nan, -2.0]}, "joint 1 of the start state .* nan to 2.0000"),
        ({"velocity_limit": np.ones(3)}, "velocity_limit: expected shape"),
        ({"intervals": 3}, "at least 4"),
        ({"effort_weight": -1.0}, "effort weight"),
        ({"effort_weight": np.nan}, "effort weight"),
        ({"min_duration": 2.0, "max_duration": 1.0}, "durations"),
        ({"max_duration": 0.0}, "durations"),
        (
            {"constraints": (row(parameters=np.zeros((N, 1))),)},
            "row has parameters for 10 grid points, the grid has 11",
        ),
        ({"constraints": (row(joints=3),)}, "another number of joints"),
    ],
)
def test_an_impossible_problem_says_what_is_wrong(changes, words):
    with pytest.raises(InvalidProblem, match=f"reach: .*{words}"):
        problem(**changes)


def test_boundary_states_may_exceed_their_limits_by_rounding():
    slightly = 2.0 + 1e-12
    assert problem(start_position=[slightly, -slightly], start_velocity=[3.0 + 1e-12, 0.0]).joints == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lower": np.array([6.0])}, "a lower bound above its upper bound"),
        ({"scale": np.ones(2)}, "bounds and scale need one entry for each of the 1 rows"),
        ({"parameters": np.zeros((N + 1, 2))}, "1 parameters a node expected, got 2"),
    ],
)
def test_impossible_rows_say_what_is_wrong(changes, words):
    with pytest.raises(InvalidProblem, match=f"row: {words}"):
        row(**changes)
