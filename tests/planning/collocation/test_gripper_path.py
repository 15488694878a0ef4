"""The hand's motion: rule, ends, and the duration that its limits ask for."""

import numpy as np
import pytest

from dyngrasp.planning.collocation.gripper_path import gripper_path


@pytest.mark.parametrize("N", [4, 10, 100])
def test_path_keeps_rule_and_ends(sdh2, N):
    path = gripper_path(sdh2.open_posture, sdh2.closed_posture, N)
    for duration in (0.3, 1.7):
        motion = path.over(duration)
        assert motion.dynamics_defect() < 1e-14
        np.testing.assert_array_equal(motion.position[[0, -1]], [sdh2.open_posture, sdh2.closed_posture])
        np.testing.assert_array_equal(motion.velocity[[0, -1]], 0.0)


def test_shortest_duration_is_where_a_limit_binds(sdh2):
    path = gripper_path(sdh2.open_posture, sdh2.closed_posture, 100)
    for velocity, acceleration in ((sdh2.velocity, 1e6), (1e6, sdh2.acceleration), (sdh2.velocity, sdh2.acceleration)):
        motion = path.over(path.shortest_duration(velocity, acceleration))
        use = max((np.abs(motion.velocity) / velocity).max(), (np.abs(motion.acceleration) / acceleration).max())
        assert use == pytest.approx(1.0, abs=1e-12)


def test_a_hand_that_stays_needs_no_time(sdh2):
    path = gripper_path(sdh2.closed_posture, sdh2.closed_posture, 10)
    assert path.shortest_duration(sdh2.velocity, sdh2.acceleration) == 0.0
    np.testing.assert_array_equal(path.position, np.tile(sdh2.closed_posture, (11, 1)))
