from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import ScenarioError
from dyngrasp.experiments.draws import draw_trial, trial_seed
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.workcell import Workcell, load_workcell

SCENARIO = Path(__file__).parents[2] / "scenarios" / "static_sdh2.toml"


def workcell(*overrides: str) -> Workcell:
    return load_workcell(load_scenario(SCENARIO, overrides), SCENARIO)


def error_of(cell: Workcell, seed: int) -> pin.SE3:
    """The error of the believed pose, in the grasp frame."""
    trial, T_object_grasp = draw_trial(cell, seed), cell.task.grasp_object.grasps[0].T_object_grasp
    return (trial.T_world_object * T_object_grasp).actInv(trial.T_world_object_believed * T_object_grasp)


def test_a_seed_gives_the_same_trial_again():
    cell = workcell()
    first, again, other = draw_trial(cell, 5), draw_trial(cell, 5), draw_trial(cell, 6)
    assert first.T_world_object == again.T_world_object
    assert first.T_world_object_believed == again.T_world_object_believed
    np.testing.assert_array_equal(first.variation.armature_factors, again.variation.armature_factors)
    assert first.T_world_object != other.T_world_object


def test_trial_seeds_depend_on_study_and_index_alone_and_survive_json():
    seeds = [trial_seed(7, i) for i in range(1000)]
    assert seeds == [trial_seed(7, i) for i in range(1000)]
    assert len(set(seeds)) == 1000
    assert max(seeds) < 2**53
    assert trial_seed(8, 0) != trial_seed(7, 0)


def test_parts_stand_on_the_ground_inside_the_papers_box():
    cell = workcell()
    for i in range(50):
        T = draw_trial(cell, trial_seed(1, i)).T_world_object
        assert 0.6 <= T.translation[0] <= 0.7
        assert -0.1 <= T.translation[1] <= 0.1
        assert T.translation[2] == cell.task.grasp_object.rest_height
        np.testing.assert_allclose(T.rotation[:, 2], [0, 0, 1], atol=1e-15)


def test_errors_stay_within_their_bounds_and_fill_them():
    cell = workcell("pose.position_mm=4.0", "pose.rotation_deg=2.0")
    errors = [error_of(cell, trial_seed(2, i)) for i in range(200)]
    distances = [1e3 * np.linalg.norm(e.translation) for e in errors]
    angles = [np.rad2deg(np.linalg.norm(pin.log3(e.rotation))) for e in errors]
    assert 3.8 < max(distances) <= 4.0 + 1e-9
    assert 1.9 < max(angles) <= 2.0 + 1e-9


@pytest.mark.parametrize(("key", "axis"), [("along_mm", 0), ("across_mm", 1), ("up_mm", 2)])
def test_offsets_act_along_the_axes_of_the_grasp(key, axis):
    cell = workcell("pose.position_mm=0.0", "pose.rotation_deg=0.0", f"pose.{key}=7.0")
    offset = 1e3 * error_of(cell, 3).translation
    expected = np.zeros(3)
    expected[axis] = 7.0
    np.testing.assert_allclose(np.abs(offset), expected, atol=1e-9)


def test_an_error_leaves_part_and_plant_where_they_were():
    exact, wrong = workcell(), workcell("pose.position_mm=9.0")
    a, b = draw_trial(exact, 4), draw_trial(wrong, 4)
    assert a.T_world_object == b.T_world_object
    assert a.variation.friction == b.variation.friction


def test_the_true_pose_is_the_true_pose():
    cell = workcell("pose.source=truth", "pose.position_mm=0.0", "pose.rotation_deg=0.0")
    trial = draw_trial(cell, 11)
    assert trial.T_world_object_believed is not None
    np.testing.assert_allclose(trial.T_world_object_believed.homogeneous, trial.T_world_object.homogeneous, atol=1e-15)


RELOCATION = ("relocation.distance_mm=[20,50]", "relocation.at_s=[1.5,2.5]", "relocation.within_s=0.4")


def test_a_relocation_is_drawn_within_its_ranges_and_leaves_the_rest_as_it_is():
    moved, still = workcell(*RELOCATION), workcell()
    for index in range(40):
        a, b = draw_trial(moved, trial_seed(3, index)), draw_trial(still, trial_seed(3, index))
        plate = a.conveyor
        assert plate is not None
        assert b.conveyor is None
        start, stop = plate.run
        assert 1.5 <= start <= 2.5
        assert stop - start == pytest.approx(0.4)
        assert 0.02 <= plate.speed * 0.4 <= 0.05
        # Nobody knows beforehand: at first the part stands.
        assert not a.twist_world.any()
        assert not a.twist_believed.any()
        lifted = a.T_world_object.translation - b.T_world_object.translation
        np.testing.assert_allclose(lifted, [0.0, 0.0, plate.height], atol=1e-15)
        assert a.variation.friction == b.variation.friction


def test_a_part_stands_on_one_plate():
    with pytest.raises(ScenarioError, match="one of them"):
        workcell(*RELOCATION, "conveyor.speed_m_s=0.1")
