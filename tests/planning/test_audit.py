"""A good plan passes; for every entry something makes that one fail and no other; NaN never passes."""

import copy
from dataclasses import replace

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.planning.audit import audit, standstill
from dyngrasp.planning.cell_geometry import cell_geometry
from dyngrasp.planning.part_motion import part_motion, part_poses
from dyngrasp.planning.plan_samples import SUBSTEPS
from dyngrasp.planning.problem import AuditEntry
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan, Trajectory

ENTRIES = (
    "dynamics",
    "join_position",
    "join_velocity",
    "pregrasp_position",
    "pregrasp_angle",
    "grasp_position",
    "grasp_angle",
    "place_position",
    "place_angle",
    "lift_velocity",
    "rest_at_place",
    "position",
    "velocity",
    "acceleration",
    "gripper_position",
    "gripper_velocity",
    "gripper_acceleration",
    "torque",
    "funnel",
    "grasp_axis",
    "grasp_dip",
    "grasp_tilt",
    "hold",
    "ground_clearance",
    "part_clearance",
    "self_clearance",
    "carried_clearance",
)

TINY = 1e-8  # rad or rad/s: above the tolerance of joins and of rest, far below that of a length


def failures(plan, targets, task) -> list[str]:
    return [entry.name for entry in audit(plan, targets, task).failures]


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
    bad = copy.copy(plan)
    object.__setattr__(bad, "arm", phases)
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


# --- tests ------------------------------------------------------------------------------------------------------------


def test_a_good_plan_passes(plan, targets, task):
    report = audit(plan, targets, task)
    assert report.ok
    assert tuple(entry.name for entry in report.entries) == ENTRIES
    for entry in report.entries:
        assert plan.start_time <= entry.time <= plan.end_time


def test_there_is_a_failure_for_every_entry():
    assert set(PLANS) | set(TASKS) | set(BODIES) == set(ENTRIES)


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_for_which_only_this_fails(plan, targets, task, name):
    assert failures(PLANS[name](plan, task), targets, task) == [name]


@pytest.mark.parametrize("name", TASKS)
def test_a_task_for_which_only_this_fails(plan, targets, task, name):
    assert failures(plan, targets, TASKS[name](task, plan)) == [name]


@pytest.mark.parametrize("name", BODIES)
def test_bodies_for_which_only_this_fails(plan, targets, task, name):
    assert failures(plan, targets, BODIES[name](task, targets)) == [name]


@pytest.mark.parametrize("array", ["position", "velocity", "acceleration"])
@pytest.mark.parametrize("of", ["arm", "gripper"])
@pytest.mark.parametrize("phase", range(3), ids=PHASE_NAMES)
def test_not_a_number_never_passes(plan, targets, task, of, phase, array):
    """A trajectory refuses it; were it to slip through, the audit would not."""
    trajectories = [copy.copy(trajectory) for trajectory in getattr(plan, of)]
    values = getattr(trajectories[phase], array).copy()
    values[17, 1] = np.nan
    object.__setattr__(trajectories[phase], array, values)
    bad = copy.copy(plan)
    object.__setattr__(bad, of, tuple(trajectories))
    failed = failures(bad, targets, task)
    assert array in failed or f"gripper_{array}" in failed
    if array == "position":
        assert {"ground_clearance", "part_clearance", "self_clearance"} <= set(failed)


def test_nan_entries_fail_whatever_they_compare_with():
    for worst, bound, tolerance in ((np.nan, 1.0, 0.0), (0.0, np.nan, 0.0), (0.0, 1.0, np.nan)):
        for at_least in (False, True):
            assert not AuditEntry("torque", worst, bound, at_least, tolerance, "", 0.0).ok


def test_what_is_past_is_not_looked_at(plan, targets, task):
    """Fingers that close too fast count until they have closed, and no longer."""
    strict = TASKS["gripper_velocity"](task, plan)
    fastest = audit(plan, targets, strict)["gripper_velocity"].time
    assert plan.phase_ends[0] < fastest < plan.phase_ends[1]
    for since, failed in (
        (-np.inf, ["gripper_velocity"]),
        (plan.phase_ends[0] - 0.2, ["gripper_velocity"]),
        (fastest - 0.02, ["gripper_velocity"]),
        (fastest + 0.05, []),
        (plan.phase_ends[1], []),
    ):
        report = audit(plan, targets, strict, since=float(since))
        assert [entry.name for entry in report.failures] == failed
        assert ("funnel" in [entry.name for entry in report.entries]) == (since < plan.phase_ends[0])
        of_the_whole_plan = {"dynamics", "join_position", "join_velocity"}
        assert all(entry.time >= since for entry in report.entries if entry.name not in of_the_whole_plan)


def test_only_the_delivery_is_left(plan, targets, task):
    report = audit(plan, targets, task, since=float(plan.phase_ends[1]) + 0.1)
    assert report.ok
    names = {entry.name for entry in report.entries}
    assert not names & {"funnel", "grasp_axis", "grasp_dip", "grasp_tilt", "pregrasp_position", "grasp_angle"}
    assert {"torque", "hold", "place_position", "part_clearance", "carried_clearance"} <= names


def test_a_part_elsewhere_is_noticed(plan, targets, task):
    """The boundary states rest on where the part is said to be, not on what the plan says of it."""
    elsewhere = targets.T_world_object.copy()
    elsewhere.translation = elsewhere.translation + np.array([2e-6, 0.0, 0.0])
    assert failures(plan, replace(targets, T_world_object=elsewhere), task) == ["pregrasp_position", "grasp_position"]


def test_a_moving_part_is_followed(plan, targets, task):
    """A part that stands still is where it was; one that came by is not where this plan expects it at the pre-grasp."""
    grasp_time = float(plan.phase_ends[1])
    spin = replace(targets, grasp_time=grasp_time, twist_world=np.array([0, 0, 0, 0, 0, 0.002]))
    # The grasp lies on the axis of this turn, so that only the angle at the pre-grasp differs.
    assert failures(plan, spin, task) == ["pregrasp_angle"]
    angle = audit(plan, spin, task)["pregrasp_angle"].worst
    assert angle == pytest.approx(0.002 * plan.durations[1], rel=1e-6)
    drift = replace(targets, grasp_time=grasp_time, twist_world=np.array([1e-4, 0, 0, 0, 0, 0]))
    assert failures(plan, drift, task) == ["pregrasp_position"]
    T, twist = targets.T_world_object, np.array([0.1, -0.2, 0.05, 0.3, -0.4, 0.5])
    moving = replace(targets, grasp_time=2.0, twist_world=twist)
    times = np.array([0.0, 1.3, 2.0, 2.5])
    for part in (moving, replace(moving, twist_world=np.array([0.1, 0, 0, 0, 0, 0])), targets):
        R, p = np.empty((3, 3, 4)), np.empty((3, 4))
        part_poses(*part_motion(part), times, R, p)
        for k, t in enumerate(times):
            expected = part.T_world_object_at(t)
            np.testing.assert_allclose(R[..., k], expected.rotation, atol=1e-14)
            np.testing.assert_allclose(p[:, k], expected.translation, atol=1e-14)
    assert moving.T_world_object_at(2.5) == T


def busier_pad(wrench: pin.Force, task, grasp) -> float:
    """Friction that the two pads need over what they have, by the statics of two contacts at y = ±w/2."""
    friction, N = task.grasp_object.friction, task.settings.grip_share * task.gripper.pinch_force
    arm = np.array([0.0, grasp.width / 2, 0.0])
    shares = []
    for side in (1, -1):
        # Half of the force each, and the couple whose moment about x and z is the wrench's.
        couple = np.cross(wrench.angular * [1, 0, 1], side * arm) / (2 * arm @ arm)
        tangential = wrench.linear * [1, 0, 1] / 2 + couple
        normal = N - side * wrench.linear[1] / 2
        load = np.hypot(np.linalg.norm(tangential) / friction.sliding, wrench.angular[1] / 2 / friction.torsional)
        shares.append(load / normal)
    return max(shares)


def one_sample_after_the_other(plan, targets, task, substeps: int) -> dict[str, float]:
    """Worst values by Pinocchio, called for each sample by itself, on a grid `substeps` times as fine as the plan's."""
    robots = (task.robot_empty, task.robot_empty, task.robot_loaded(targets.grasp))
    torque, h, lateral, dip, angle, share = [], [], [], [], [], []
    part, gripper, model = task.grasp_object, task.gripper, task.robot.pin_model
    data, tip = model.createData(), task.robot.tip_id
    T_flange_closed = gripper.T_flange_hand * gripper.T_hand_grasp(targets.gripper_closed)
    part_in_grasp = targets.grasp.T_object_grasp.inverse().act(part.spatial_inertia)
    for phase, (arm, fingers, robot) in enumerate(zip(plan.arm, plan.gripper, robots, strict=True)):
        for t in np.linspace(0.0, arm.duration, substeps * arm.intervals + 1):
            state, q_h = arm.sample(t), fingers.sample(t).position
            q, w, v = state.position, state.velocity, state.acceleration
            torque.append(np.abs(robot.inverse_dynamics(q, w, v) / robot.limits.torque).max())
            hand = robot.forward_kinematics(q) * gripper.T_flange_hand * gripper.T_hand_grasp(q_h)
            x, y, z = targets.T_world_grasp.actInv(hand.translation)
            if phase == 0:
                f = part.funnel
                h.append(z - f.z_threshold * (1 - np.exp(-0.5 * ((x / f.sigma_x) ** 2 + (y / f.sigma_y) ** 2))))
            elif phase == 1:
                lateral.append(np.hypot(x, y))
                dip.append(z)
                angle.append(np.linalg.norm(pin.log3(targets.T_world_grasp.rotation.T @ hand.rotation)))
            else:
                pin.forwardKinematics(model, data, q, w, v)
                pin.updateFramePlacement(model, data, tip)
                velocity = T_flange_closed.actInv(pin.getFrameVelocity(model, data, tip, pin.LOCAL))
                acceleration = T_flange_closed.actInv(pin.getFrameAcceleration(model, data, tip, pin.LOCAL))
                upward = (data.oMf[tip] * T_flange_closed).rotation.T @ -model.gravity.linear
                acceleration.linear = acceleration.linear + upward
                wrench = part_in_grasp * acceleration + velocity.cross(part_in_grasp * velocity)
                share.append(busier_pad(wrench, task, targets.grasp))
    return {
        "torque": max(torque),
        "funnel": min(h),
        "grasp_axis": max(lateral),
        "grasp_dip": min(dip),
        "grasp_tilt": max(angle),
        "hold": max(share),
    }


def test_worst_values_are_those_of_one_sample_after_the_other(plan, targets, task):
    report = audit(plan, targets, task)
    for name, value in one_sample_after_the_other(plan, targets, task, 1).items():
        # Rounding of kinematics and dynamics; the funnel's wall climbs up to 30 m per metre.
        assert report[name].worst == pytest.approx(value, abs=1e-11), name


@pytest.mark.parametrize(
    ("name", "key"),
    [("grasp_axis", "lateral_tolerance"), ("grasp_dip", "dip_tolerance"), ("grasp_tilt", "tilt_tolerance")],
)
def test_what_is_broken_between_two_grid_points_only_is_found(plan, targets, task, name, key):
    """The hand goes aside half way through the grasp, between two points of a coarse grid; the limit lies between."""
    aside = PLANS[name](plan, task)
    coarse = with_arm(aside, *(every_other(phase, 20) for phase in aside.arm))
    object.__setattr__(coarse, "gripper", tuple(every_other(phase, 20) for phase in aside.gripper))
    grid, inside = (one_sample_after_the_other(coarse, targets, task, substeps)[name] for substeps in (1, SUBSTEPS))
    assert abs(inside) > 1.1 * abs(grid), "no peak between the grid points"
    strict = replace(task, settings=replace(task.settings, **{key: abs(grid + inside) / 2}))
    entry = audit(coarse, targets, strict)[name]
    assert not entry.ok
    assert entry.worst == pytest.approx(inside, abs=1e-11)


def test_entry_of_that_name_or_those_there_are(plan, targets, task):
    report = audit(plan, targets, task)
    assert report["torque"].name == "torque"
    with pytest.raises(KeyError, match="funnel"):
        report["torqe"]


def test_a_plan_that_stops_on_its_way_is_told_from_one_that_does_not(plan, task):
    entry = standstill(plan, task)
    assert entry.ok
    # What the entry looks at every half grid step is on a finer grid no slower than a little.
    times = np.linspace(
        plan.start_time + 0.02 * plan.durations.sum(), plan.end_time - 0.02 * plan.durations.sum(), 5000
    )
    speeds = [np.abs(plan.sample(t).arm.velocity / task.robot.limits.velocity).max() for t in times]
    assert entry.worst == pytest.approx(min(speeds), abs=2e-3)
    assert np.abs(plan.sample(entry.time).arm.velocity / task.robot.limits.velocity).max() == pytest.approx(entry.worst)
    # The same path on a clock τ(s) that starts and ends as it did but stands still at a quarter: τ' = 1 − sin 2πs.
    arm = plan.arm[0]
    s = np.linspace(0.0, 1.0, arm.intervals + 1)
    rate, curvature = 1.0 - np.sin(2 * np.pi * s[:, None]), -2 * np.pi * np.cos(2 * np.pi * s[:, None])
    q, w, v = arm.sample_many(arm.duration * (s + (np.cos(2 * np.pi * s) - 1.0) / (2 * np.pi)))
    stopping = Trajectory(arm.duration, q, w * rate, v * rate**2 + w * curvature / arm.duration)
    found = standstill(replace(plan, arm=(stopping, *plan.arm[1:])), task)
    assert not found.ok
    assert found.time == pytest.approx(plan.start_time + 0.25 * arm.duration, abs=arm.duration / arm.intervals)
    # What is past does not count.
    assert standstill(replace(plan, arm=(stopping, *plan.arm[1:])), task, plan.start_time + 0.5 * arm.duration).ok
