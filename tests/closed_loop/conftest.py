"""One planned grasp that the tests of the loop share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.episode import EpisodeSettings, grasp_controller, run_episode
from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene
from dyngrasp.simulation.variation import PlantVariation
from dyngrasp.trajectory import GraspPlan


@dataclass(frozen=True)
class PlannedGrasp:
    """A task, its plan and the pose that it was planned for."""

    task: GraspTask
    targets: GraspTargets
    plan: GraspPlan

    def run(
        self,
        *,
        seed: int = 1,
        friction: float | None = None,
        error: pin.SE3 | None = None,
        settings: EpisodeSettings | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> EpisodeRecord:
        """Carry the plan out on a plant drawn from `seed`, the part off its expected pose by `error` (object frame)."""
        task = self.task
        friction_range = (0.6, 0.9) if friction is None else (friction, friction)
        variation = PlantVariation.draw(np.random.default_rng(seed), task.robot.n, friction_range=friction_range)
        plant = MujocoPlant(
            build_scene(task.robot, task.gripper, task.grasp_object, variation),
            self.plan.arm[0].position[0],
            self.plan.gripper[0].position[0],
            self.targets.T_world_object * (error or pin.SE3.Identity()),
            t=self.plan.start_time,
        )
        return run_episode(
            self.plan, plant, grasp_controller(task, self.targets.grasp, 1e-3), settings, progress=progress
        )


@pytest.fixture(scope="session")
def planned():
    """A grasp of the casting, planned on a coarse grid: the loop does not care."""
    part = load_object("casting")
    place = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])
    task = GraspTask(load_robot("iiwa14"), load_gripper("sdh2"), part, place)
    # Close to the part: a short episode.
    q_start = np.deg2rad([-10.0, 30.0, 0.0, -80.0, 0.0, 70.0, 0.0])
    T_world_object = pin.SE3(pin.utils.rotate("z", 0.3), np.array([0.64, -0.03, part.rest_height]))
    targets = grasp_targets(T_world_object, task, q_start)
    planner = CollocationPlanner(task, CollocationSettings(effort_weight=0.1, intervals=50))
    return PlannedGrasp(task, targets, planner.plan(q_start, targets).require())


@pytest.fixture(scope="session")
def delivered(planned):
    """The record of that plan on a plant that deviates as the studies assume."""
    return planned.run()
