import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.catalogue import load_robot
from dyngrasp.models.limits import MARGIN, JointLimits, coriolis_bounds
from dyngrasp.models.robot import read_robot

SCRIPT = Path(__file__).parents[2] / "scripts" / "coriolis_bounds.py"


def test_bounds_of_a_planar_arm_are_those_of_the_textbook(tmp_path):
    """Two links in a plane: C q̇ = h [−2 w1 w2 − w2², w1²] sin q2 with h = m2 l1 c2, worst at q2 = ±90°."""
    m2, l1, c2 = 1.5, 0.4, 0.2
    (tmp_path / "arm.xml").write_text(
        f"<mujoco><worldbody><body name='a'><joint name='j1' axis='0 0 1'/>"
        f"<inertial pos='0.2 0 0' mass='2' diaginertia='.01 .01 .01'/>"
        f"<body name='b' pos='{l1} 0 0'><joint name='j2' axis='0 0 1'/>"
        f"<inertial pos='{c2} 0 0' mass='{m2}' diaginertia='.01 .01 .01'/><site name='tip' pos='0.4 0 0'/>"
        f"</body></body></worldbody></mujoco>"
    )
    (tmp_path / "model.toml").write_text(
        "kind='robot'\nname='planar'\nmjcf='arm.xml'\ntip_frame='tip'\n[limits]\nposition_lower_deg=[-170, -170]\n"
        "position_upper_deg=[170, 170]\nvelocity_deg_per_s=[100, 120]\ntorque_nm=[50, 50]\n"
    )
    w1, w2 = np.deg2rad([100, 120])
    worst = m2 * l1 * c2 * np.array([2 * w1 * w2 + w2**2, w1**2])
    bounds = coriolis_bounds(read_robot(tmp_path / "model.toml"), samples=500)
    # Rounded up to 0.01 Nm, and the ascent stops within a millionth of the peak.
    assert (bounds >= MARGIN * worst * (1 - 1e-6)).all()
    assert (bounds <= MARGIN * worst + 0.01 + 1e-9).all()


def test_bounds_hold_for_states_they_have_not_seen(robot, payload):
    loaded = robot.with_payload(payload)
    bounds = coriolis_bounds(loaded, samples=4000, seed=0)
    random, limits = np.random.default_rng(99), loaded.limits
    q = random.uniform(limits.position_lower, limits.position_upper, (5000, robot.n))
    w = np.copysign(limits.velocity, random.uniform(-1, 1, (5000, robot.n)))
    worst = np.max([np.abs(loaded.bias_torque(*state)) for state in zip(q, w, strict=True)], axis=0)
    assert (worst <= bounds).all()


def test_same_seed_same_bounds_and_speed_enters_squared(payload):
    loaded = load_robot("iiwa14").with_payload(payload)
    once, again = (coriolis_bounds(loaded, samples=2000, seed=3) for _ in range(2))
    np.testing.assert_array_equal(once, again)
    half = coriolis_bounds(loaded, samples=2000, seed=3, velocity_fraction=0.5)
    # Both are rounded up to 0.01 Nm; two ascents of the same peak end within its flat top.
    np.testing.assert_allclose(half, once / 4, rtol=0.005, atol=0.0101)


def test_the_script_reproduces_the_figures_in_the_model_file(capsys):
    assert runpy.run_path(str(SCRIPT))["main"](["iiwa14"]) == 0
    printed = capsys.readouterr().out.splitlines()[0]
    figures = np.array([float(x) for x in printed.split("[")[1].rstrip("]").split(",")])
    # Another build of the optimiser may stop one unit of the last digit elsewhere.
    np.testing.assert_allclose(load_robot("iiwa14").limits.coriolis, figures, rtol=0, atol=0.0101)


def test_script_reports_an_unknown_name(capsys):
    assert runpy.run_path(str(SCRIPT))["main"](["nosuch"]) == 2
    assert "iiwa14" in capsys.readouterr().err


GOOD: dict[str, Any] = {
    "position_lower": [-1.0, -1.0],
    "position_upper": [1.0, 1.0],
    "velocity": [1.0, 1.0],
    "torque": [1.0, 1.0],
}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"position_lower": [-1.0, 2.0]}, "below"),
        ({"position_lower": [-1.0, np.nan]}, "below"),
        ({"velocity": [1.0, 0.0]}, "velocity"),
        ({"torque": [1.0]}, "torque"),
        ({"acceleration": [1.0, -1.0]}, "acceleration"),
        ({"coriolis": [0.0, np.nan]}, "coriolis"),
    ],
)
def test_impossible_limits_are_refused(change, says):
    with pytest.raises(InvalidProblem, match=says):
        JointLimits(**{**GOOD, **change})


def test_limits_default_to_no_acceleration_limit_and_are_read_only():
    limits = JointLimits(**GOOD)
    assert np.isinf(limits.acceleration).all()
    assert not limits.coriolis.any()
    with pytest.raises(ValueError, match="read-only"):
        limits.velocity[0] = 2.0
    with pytest.raises(InvalidProblem, match="fraction"):
        coriolis_bounds(load_robot("iiwa14"), velocity_fraction=0.0)
