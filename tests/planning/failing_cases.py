"""For every entry of an audit a plan, a task or a body that makes that one fail and no other."""

from dataclasses import fields, replace

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin

from dyngrasp.planning.cell_geometry import cell_geometry
from dyngrasp.trajectory import GraspPlan, Trajectory

TINY = 1e-8  # rad or rad/s: above the tolerance of joins and of rest, far below that of a length


# --- plans that differ ------------------------------------------------------------------------------------------------


def perturbed(trajectory: Trajectory, direction, start=(0.0, 0.0), end=(0.0, 0.0), middle=None, nodes=None):
    """A trajectory aside by a multiple of `direction` (n,) that still satisfies the trapezoidal rule.

    `start` and `end` are the multiples of position and velocity at the ends, `middle` that of the position half way;
    only the first `nodes` accelerations change.
    """
    N, step = trajectory.intervals, trajectory.duration / trajectory.intervals
    nodes = nodes or N + 1
    velocity = np.zeros((N + 1, N + 1))
    for k in range(N):
        velocity[k + 1] = velocity[k]
        velocity[k + 1, [k, k + 1]] += step / 2
    position = np.zeros((N + 1, N + 1))
    for k in range(N):
        position[k + 1] = position[k] + step / 2 * (velocity[k] + velocity[k + 1])
    rows, wanted = [position[N], velocity[N]], [end[0] - start[0] - N * step * start[1], end[1] - start[1]]
    if middle is not None:
        rows.append(position[N // 2])
        wanted.append(middle - start[0] - N // 2 * step * start[1])
    v: np.ndarray = np.zeros(N + 1)
    v[:nodes] = np.linalg.lstsq(np.array(rows)[:, :nodes], np.array(wanted), rcond=None)[0]
    w, q = start[1] + velocity @ v, start[0] + trajectory.times * start[1] + position @ v
    return Trajectory(
        trajectory.duration,
        trajectory.position + np.outer(q, direction),
        trajectory.velocity + np.outer(w, direction),
        trajectory.acceleration + np.outer(v, direction).astype(float),
    )


def with_arm(plan: GraspPlan, *phases: Trajectory) -> GraspPlan:
    """The plan with other trajectories of the arm, whatever a plan itself would say of them."""
    return unchecked(plan, arm=phases)


def unchecked(plan: GraspPlan, **changes) -> GraspPlan:
    """The plan with other attributes, whatever a plan itself would say of them."""
    bad = object.__new__(GraspPlan)
    for field in fields(GraspPlan):
        object.__setattr__(bad, field.name, changes.get(field.name, getattr(plan, field.name)))
    return bad


def joint_step(task, plan, phase: int, node: int, twist) -> np.ndarray:
    """(n,) joint step that moves the hand at G by a small twist: three lengths (m), three angles (rad), world axes."""
    q, q_h = plan.arm[phase].position[node], plan.gripper[phase].position[node]
    lever = task.robot.forward_kinematics(q).rotation @ (task.gripper.T_flange_hand.act(task.gripper.grasp_point(q_h)))
    J = task.robot.jacobian(q).copy()
    J[:3] += np.cross(J[3:], lever, axis=0)
    return np.linalg.lstsq(J, np.asarray(twist, dtype=float), rcond=None)[0]


def displaced_at(plan: GraspPlan, task, end_of: int, twist) -> GraspPlan:
    """The hand stands aside at the end of one phase, and comes back in the next one."""
    step = joint_step(task, plan, end_of, -1, twist)
    arm = list(plan.arm)
    arm[end_of] = perturbed(arm[end_of], step, end=(1.0, 0.0))
    if end_of < 2:
        arm[end_of + 1] = perturbed(arm[end_of + 1], step, start=(1.0, 0.0))
    return with_arm(plan, *arm)


def displaced_within_grasp(plan: GraspPlan, task, twist) -> GraspPlan:
    step = joint_step(task, plan, 1, plan.arm[1].intervals // 2, twist)
    return with_arm(plan, plan.arm[0], perturbed(plan.arm[1], step, middle=1.0), plan.arm[2])


def lowered(plan: GraspPlan, task) -> GraspPlan:
    """The hand is still moving down by 1 mm/s as the grasp ends, and turns upwards at once."""
    lift = joint_step(task, plan, 1, -1, [0.0, 0.0, -(task.settings.lift_speed + 0.001), 0.0, 0.0, 0.0])
    return with_arm(
        plan,
        plan.arm[0],
        perturbed(plan.arm[1], lift, end=(0.0, 1.0)),
        perturbed(plan.arm[2], lift, start=(0.0, 1.0), nodes=12),
    )


def every_other(trajectory: Trajectory, k: int) -> Trajectory:
    """The motion on every k-th grid point; between them it is another one."""
    rows = slice(None, None, k)
    return Trajectory(
        trajectory.duration, trajectory.position[rows], trajectory.velocity[rows], trajectory.acceleration[rows]
    )


def off_the_rule(plan: GraspPlan) -> GraspPlan:
    acceleration = plan.arm[0].acceleration.copy()
    acceleration[5, 2] += 1e-5
    first = Trajectory(plan.arm[0].duration, plan.arm[0].position, plan.arm[0].velocity, acceleration)
    return with_arm(plan, first, *plan.arm[1:])


def one_joint(task, i: int = 1) -> np.ndarray:
    return np.eye(task.robot.n)[i]


PLANS = {
    "dynamics": lambda plan, task: off_the_rule(plan),
    "join_position": lambda plan, task: with_arm(
        plan, *plan.arm[:2], perturbed(plan.arm[2], one_joint(task), (TINY, 0.0), (TINY, 0.0))
    ),
    "join_velocity": lambda plan, task: with_arm(
        plan, *plan.arm[:2], perturbed(plan.arm[2], one_joint(task), (0.0, TINY))
    ),
    "pregrasp_position": lambda plan, task: displaced_at(plan, task, 0, [3e-6, 0, 0, 0, 0, 0]),
    "pregrasp_angle": lambda plan, task: displaced_at(plan, task, 0, [0, 0, 0, 0, 3e-5, 0]),
    "grasp_position": lambda plan, task: displaced_at(plan, task, 1, [0, 3e-6, 0, 0, 0, 0]),
    "grasp_angle": lambda plan, task: displaced_at(plan, task, 1, [0, 0, 0, 0, 0, 3e-5]),
    "place_position": lambda plan, task: displaced_at(plan, task, 2, [0, 0, 3e-6, 0, 0, 0]),
    "place_angle": lambda plan, task: displaced_at(plan, task, 2, [0, 0, 0, 3e-5, 0, 0]),
    "lift_velocity": lowered,
    "rest_at_place": lambda plan, task: with_arm(
        plan, *plan.arm[:2], perturbed(plan.arm[2], one_joint(task), end=(0.0, TINY))
    ),
    "grasp_axis": lambda plan, task: displaced_within_grasp(plan, task, [0.002, 0, 0, 0, 0, 0]),
    "grasp_dip": lambda plan, task: displaced_within_grasp(plan, task, [0, 0, -0.004, 0, 0, 0]),
    "grasp_tilt": lambda plan, task: displaced_within_grasp(plan, task, [0, 0, 0, 0, 0, np.deg2rad(1.5)]),
}


# --- tasks that ask for more ------------------------------------------------------------------------------------------


def peak(plan: GraspPlan, of: str, what: str) -> np.ndarray:
    return np.max([np.abs(getattr(phase, what)).max(axis=0) for phase in getattr(plan, of)], axis=0)


def arm_limited(task, plan, **limits):
    return replace(task, robot=replace(task.robot, limits=replace(task.robot.limits, **limits)))


def narrower_range(task, plan):
    highest = np.max([phase.position.max(axis=0) for phase in plan.arm], axis=0)
    upper = task.robot.limits.position_upper.copy()
    upper[3] = highest[3] - 1e-3
    return arm_limited(task, plan, position_upper=upper)


def narrower_gripper_range(task, plan):
    highest = np.max([phase.position.max(axis=0) for phase in plan.gripper], axis=0)
    upper = task.gripper.upper.copy()
    upper[0] = highest[0] - 1e-3
    return replace(task, gripper=replace(task.gripper, upper=upper))


def with_part(task, **changes):
    return replace(task, grasp_object=replace(task.grasp_object, **changes))


def weaker(task, share):
    return arm_limited(task, None, torque=share * task.robot.limits.torque)


TASKS = {
    "position": narrower_range,
    "velocity": lambda task, plan: arm_limited(task, plan, velocity=peak(plan, "arm", "velocity") * 0.99),
    "acceleration": lambda task, plan: arm_limited(task, plan, acceleration=peak(plan, "arm", "acceleration") * 0.99),
    "gripper_position": narrower_gripper_range,
    "gripper_velocity": lambda task, plan: replace(
        task,
        gripper=replace(task.gripper, velocity=np.full(task.gripper.m, 0.99 * peak(plan, "gripper", "velocity")[0])),
    ),
    "gripper_acceleration": lambda task, plan: replace(
        task, gripper=replace(task.gripper, acceleration=0.9 * task.gripper.acceleration)
    ),
    "torque": lambda task, plan: weaker(task, 0.15),
    "funnel": lambda task, plan: with_part(
        task, funnel=replace(task.grasp_object.funnel, sigma_x=1e-4, sigma_y=1e-4, z_threshold=0.2)
    ),
    "hold": lambda task, plan: with_part(task, friction=replace(task.grasp_object.friction, sliding=0.1)),
}


# --- bodies that are in the way ---------------------------------------------------------------------------------------


def grown(task, targets, name: str, radius: float):
    """The same task with one body of arm or hand replaced by a larger ball."""
    fresh = replace(task)
    cell = cell_geometry(fresh, targets.grasp.name)
    cell.shapes[cell.names.index(name)] = coal.Sphere(radius)
    cell.refresh()
    return fresh


def hanging_lower(task, targets):
    """The same task with a part that hangs 2 mm lower in the hand than it was taken."""
    fresh = replace(task)
    cell = cell_geometry(fresh, targets.grasp.name)
    down = pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.002]))
    part_in_grasp = targets.grasp.T_object_grasp.inverse()
    cell.T_flange_part = cell.T_flange_part * part_in_grasp.inverse() * down * part_in_grasp
    cell.refresh()
    return fresh


BODIES = {
    "ground_clearance": lambda task, targets: grown(task, targets, "link_1_collision_1", 0.30),
    "part_clearance": lambda task, targets: grown(task, targets, "finger_1_distal_collision", 0.03),
    "self_clearance": lambda task, targets: grown(task, targets, "link_4_collision_2", 0.36),
    "carried_clearance": hanging_lower,
}
