"""From a plan and a record to the curves that the figures draw."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.report.figures import MotionCurves, trajectory_figure
from dyngrasp.trajectory import GraspPlan

# Samples of a plan over its whole duration: enough that no bend of a curve shows as a corner at print size.
SAMPLES = 800


def planned_curves(plan: GraspPlan, targets: GraspTargets, task: GraspTask) -> MotionCurves:
    """Curves of a plan; the torques are those of the nominal model, the part counts from the delivery on."""
    times = np.linspace(plan.start_time, plan.end_time, SAMPLES)
    samples = [plan.sample(t) for t in times]
    empty, loaded = task.robot_empty, task.robot_loaded(targets.grasp)
    torque = [
        (loaded if s.phase == "deliver" else empty).inverse_dynamics(s.arm.position, s.arm.velocity, s.arm.acceleration)
        for s in samples
    ]
    return MotionCurves(
        times,
        np.array([s.arm.position for s in samples]),
        np.array([s.arm.velocity for s in samples]),
        np.array(torque),
        np.array([s.gripper.position for s in samples]),
    )


def measured_curves(record: EpisodeRecord) -> MotionCurves:
    """Curves of an episode as the sensors saw it: encoder positions, filtered velocities, applied torques."""
    return MotionCurves(
        record.t,
        record.arm_measured,
        record.arm_filtered_velocity,
        record.arm_torque_applied,
        record.gripper_measured,
    )


def episode_figure(
    task: GraspTask,
    targets: GraspTargets,
    plan: GraspPlan,
    record: EpisodeRecord,
    title: str = "",
    last: GraspPlan | None = None,
) -> Figure:
    """The trajectory figure of an episode: first plan dashed, measurement solid, phases as the last plan has them."""
    return trajectory_figure(
        planned_curves(plan, targets, task),
        measured_curves(record),
        (last or plan).phase_ends,
        task.robot.limits,
        (task.gripper.lower, task.gripper.upper),
        task.robot.joint_names,
        task.gripper.joint_names,
        title,
        planned_name="planned" if last is None or last is plan else "first plan",
    )
