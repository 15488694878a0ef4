"""What a trial is carried out on: scene, plant and camera, running on one clock from the first look to the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from dyngrasp.closed_loop.camera_poses import CameraPoses
from dyngrasp.closed_loop.episode import EpisodeSettings, grasp_controller
from dyngrasp.closed_loop.first_look import FirstLook, FirstLookSettings, take_first_look
from dyngrasp.closed_loop.record import Recorder
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.vision import camera_poses
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.plant import TruthfulPlant
from dyngrasp.simulation.scene import Scene, SceneSettings, build_scene


@dataclass(frozen=True, eq=False)
class TrialWorld:
    """A trial's world.

    Attributes:
        scene: As it was built.
        plant: In it; the arm begins where the motion starts, with the gripper open.
        recorder: Of all that happens to the plant.
        rates: Of the loop.
        camera: On the hand, watching the plant; None without pictures.
    """

    scene: Scene
    plant: TruthfulPlant
    recorder: Recorder
    rates: EpisodeSettings
    camera: CameraPoses | None

    def vision(self, meta: dict[str, Any] | None = None) -> VisionRecord | None:
        """What the camera has seen so far; None if it saw nothing."""
        return None if self.camera is None else self.camera.finish(meta)


@contextmanager
def trial_world(workcell: Workcell, trial: Trial, filmed: bool | None = None) -> Iterator[TrialWorld]:
    """Build the world that a trial drew, at time zero.

    Args:
        workcell: Scenario and models.
        trial: Where the part is and how the plant deviates.
        filmed: Whether the camera takes pictures; if left out, whether the scenario's poses come from it.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
        InvalidProblem: The camera is to see a part that carries no markers.
    """
    task, period = workcell.task, 1.0 / workcell.scenario.plant.control_rate_hz
    filmed = workcell.scenario.pose.source == "camera" if filmed is None else filmed
    settings = SceneSettings(timestep=min(SceneSettings().timestep, period))
    scene = build_scene(
        task.robot,
        task.gripper,
        task.grasp_object,
        trial.variation,
        settings,
        markers=filmed,
        conveyor=trial.conveyor,
    )
    plant = MujocoPlant(scene, workcell.q_start, task.gripper.open_posture, trial.T_world_object)
    recorder = Recorder(task.robot.joint_names, task.gripper.joint_names, period)
    rates = EpisodeSettings(control_period=period)
    if not filmed:
        yield TrialWorld(scene, plant, recorder, rates, None)
        return
    with camera_poses(workcell, trial, scene) as camera:
        yield TrialWorld(scene, camera.filmed(plant), recorder, rates, camera)


def first_look(
    workcell: Workcell, world: TrialWorld, progress: Callable[[float, str], None] | None = None
) -> FirstLook | None:
    """Let the camera of a world find the part; None if the world has none: then the trial says what is believed."""
    if world.camera is None:
        return None
    task, section = workcell.task, workcell.scenario.camera
    grasps = task.grasp_object.grasps
    return take_first_look(
        workcell.q_start,
        task.gripper.open_posture,
        grasps,
        world.plant,
        # Whatever the grasp will be: the loaded arm's model serves the delivery alone.
        grasp_controller(task, grasps[0], world.rates.control_period),
        world.camera,
        world.recorder,
        FirstLookSettings(1e-3 * section.look_mm, section.look_least_s, section.look_s),
        world.rates,
        progress,
    )
