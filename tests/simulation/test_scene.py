"""The world is built from the same files as the models, and deviates only as it is told."""

import numpy as np
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Command
from dyngrasp.simulation.scene import ARM, build_scene
from dyngrasp.simulation.variation import PlantVariation


def test_masses_are_those_of_the_models(scene, robot, gripper, casting):
    model = scene.model
    assert model.body_mass[scene.part_body] == pytest.approx(casting.mass, rel=1e-9)
    total = robot.mass + gripper.inertia(gripper.open_posture).mass + casting.mass
    assert model.body_mass.sum() == pytest.approx(total, rel=1e-9)


def test_inertia_of_the_part_is_that_of_its_file(scene, casting):
    model, body = scene.model, scene.part_body
    np.testing.assert_allclose(model.body_ipos[body], casting.centre_of_mass, atol=1e-9)
    np.testing.assert_allclose(
        np.sort(model.body_inertia[body]), np.linalg.eigvalsh(casting.inertia), rtol=1e-6
    )  # fmt: skip


def test_variation_reaches_the_plant(robot, gripper, casting, scene):
    variation = PlantVariation.draw(np.random.default_rng(0), robot.n)
    model, nominal = build_scene(robot, gripper, casting, variation).model, scene.model
    dofs = scene.arm_dof
    np.testing.assert_allclose(model.dof_armature[dofs], robot.pin_model.armature * variation.armature_factors)
    np.testing.assert_allclose(model.dof_damping[dofs], variation.damping)
    np.testing.assert_allclose(model.dof_frictionloss[dofs], variation.dry_friction)
    np.testing.assert_allclose(
        model.body_mass[scene.part_body] / nominal.body_mass[scene.part_body], variation.mass_factor
    )
    for pad in scene.pad_geoms:
        np.testing.assert_allclose(model.geom_friction[pad, :2], [variation.friction, variation.torsional_friction])
        assert model.geom_condim[pad] == 4
    assert model.body_mass[model.body(ARM + "link_3").id] == nominal.body_mass[model.body(ARM + "link_3").id]


def test_only_what_may_touch_does_at_rest(scene, make_plant, robot):
    # Neighbouring links overlap by construction; any contact between robot parts here would be an artefact.
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(20):
        plant = make_plant(scene)
        middle = (robot.limits.position_upper + robot.limits.position_lower) / 2
        half = (robot.limits.position_upper - robot.limits.position_lower) / 2
        plant._data.qpos[scene.arm_qpos] = middle + 0.3 * half * rng.uniform(-1, 1, robot.n)
        plant.step(Command(np.zeros(7), np.zeros(4)))
        inside += plant.truth().contacts[4]
    assert inside == 0


def test_the_draw_stays_in_its_ranges_and_repeats():
    draws = [PlantVariation.draw(np.random.default_rng(seed), 7) for seed in range(200)]
    friction = np.array([d.friction for d in draws])
    assert 0.6 <= friction.min() < 0.63 < 0.87 < friction.max() <= 0.9
    mass = np.array([d.mass_factor for d in draws])
    assert 0.9 <= mass.min() < 0.91 < 1.09 < mass.max() <= 1.1
    armature = np.array([d.armature_factors for d in draws])
    assert 0.8 <= armature.min() < 0.81 < 1.19 < armature.max() <= 1.2
    np.testing.assert_array_equal(draws[3].damping, PlantVariation.draw(np.random.default_rng(3), 7).damping)


@pytest.mark.parametrize(
    "wrong", [{"mass_factor": 0.0}, {"friction": -0.1}, {"damping": [1.0] * 6}, {"armature_factors": [0.0] * 7}]
)
def test_refuses_a_plant_that_cannot_be(wrong):
    right = {
        "mass_factor": 1.0,
        "friction": 0.7,
        "torsional_friction": 0.01,
        "armature_factors": [1.0] * 7,
        "damping": [1.0] * 7,
        "dry_friction": [0.5] * 7,
    }
    PlantVariation(**right)
    with pytest.raises(InvalidProblem, match="plant variation"):
        PlantVariation(**(right | wrong))


def test_refuses_a_variation_for_another_arm(robot, gripper, casting):
    with pytest.raises(ValueError, match="6 joints"):
        build_scene(robot, gripper, casting, PlantVariation.ideal(6, friction=0.7, torsional_friction=0.01))
