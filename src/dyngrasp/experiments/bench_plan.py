"""How long planning takes: paired problems in one process and one thread, against other solvers of the same ones."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.errors import DyngraspError, GraspRefused, InvalidProblem, OutOfReach
from dyngrasp.experiments.plan_benchmark import CASES, MOVE, PEERS, SAME, WARM, Attempt, PlanBenchmark, Stage
from dyngrasp.experiments.serial_chain import serial_chain
from dyngrasp.experiments.statistics import timing_summary
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.models.robot import RobotModel
from dyngrasp.planning import constraints
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.residuals import worst_violation
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import PhaseProblem, PhaseSolver, Solution
from dyngrasp.planning.replanning.target_update import updated_targets
from dyngrasp.signals import Array
from dyngrasp.trajectory import PHASE_NAMES

__all__ = ["CASES", "MOVE", "PEERS", "SAME", "WARM", "Attempt", "PlanBenchmark", "Stage", "bench_plan"]

# The paper's box of poses and start; the target holds the part upright, as in scenarios/static_sdh2.toml.
BOX_X, BOX_Y = (0.6, 0.7), (-0.1, 0.1)
START_DEG = (55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0)
PLACE_DEG = (-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0)

# Of the motions that show how times grow: nearly time-optimal (s⁴/rad²).
GROWTH_WEIGHT = 1e-3

# Poses that are planned before any is timed: code that only some of them need is loaded by then.
_WARM_UP = 5

GRIDS = (50, 100, 200, 400, 800)
JOINTS = (4, 5, 6, 7, 8, 9)


def bench_plan(
    trials: int,
    seed: int,
    weights: tuple[float, ...] = (1.0, 1e-3),
    against: tuple[str, ...] = (),
    progress: Callable[[str], None] = lambda text: None,
    grids: tuple[int, ...] = GRIDS,
    joints: tuple[int, ...] = JOINTS,
) -> PlanBenchmark:
    """Measure planning.

    Args:
        trials: Poses, and as many postures in the stress case.
        seed: Of the poses and postures.
        weights: Effort weights ρ.
        against: Names in `PEERS`.
        progress: Told what is measured next.
        grids: Numbers of intervals N to see growth with.
        joints: Numbers of joints to see growth with.

    Raises:
        DyngraspError: A peer that is not known.
    """
    unknown = [name for name in against if name not in PEERS]
    if unknown:
        raise DyngraspError(f"no solver called {unknown[0]!r} to compare with; valid: {', '.join(PEERS)}")
    task = GraspTask(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"), np.deg2rad(PLACE_DEG))
    solvers: dict[str, PhaseSolver] = {"structured": StructuredSolver()}
    solvers |= {name: PEERS[name][1]() for name in against}
    attempts: list[Attempt] = []
    stages: list[Stage] = []
    for case in CASES:
        for weight in weights:
            fraction = 0.5 if case == "stress" else CollocationSettings().torque_fraction
            settings = CollocationSettings(effort_weight=weight, torque_fraction=fraction)
            planner = CollocationPlanner(task, settings, solvers["structured"])
            progress(f"{case}, ρ = {weight:g}: compiling what is missing")
            for T, q_start in _draws(case, task, planner, _WARM_UP, seed):
                _plan(case, weight, 0, planner, T, q_start, task)
                _phases(case, weight, 0, planner, T, q_start, task, solvers)
            # A pass of the garbage collector over all that was set up takes 0.1 s: it looks at what is new.
            gc.freeze()
            for trial, (T, q_start) in enumerate(_draws(case, task, planner, trials, seed)):
                progress(f"{case}, ρ = {weight:g}: {trial + 1} of {trials}")
                stages += _plan(case, weight, trial, planner, T, q_start, task)
                attempts += _phases(case, weight, trial, planner, T, q_start, task, solvers)
                attempts += _after_a_move(case, weight, trial, planner, T, q_start, task)
    progress("growth with N and with the number of joints")
    growth = tuple(_growth(solvers["structured"], min(trials, 20), seed, grids, joints))
    return PlanBenchmark(
        tuple(attempts), tuple(stages), growth, tuple(against), CollocationSettings().intervals, task.robot.n
    )


def _draws(
    case: str, task: GraspTask, planner: CollocationPlanner, trials: int, seed: int
) -> Iterator[tuple[pin.SE3, Array]]:
    """Poses within reach and start configurations from which the arm can begin; the same whatever the weight."""
    drawn = 0
    for index in range(50 * trials):
        if drawn == trials:
            return
        random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(CASES).index(case), index)))
        x, y, yaw = random.uniform(*BOX_X), random.uniform(*BOX_Y), random.uniform(-np.pi, np.pi)
        T = pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, task.grasp_object.rest_height]))
        q_start = np.deg2rad(START_DEG)
        if case == "stress":
            lower, upper = task.robot.limits.position_lower, task.robot.limits.position_upper
            q_start = random.uniform(0.7 * lower, 0.7 * upper)
        try:
            if _can_begin(planner, grasp_targets(T, task, q_start), q_start):
                drawn += 1
                yield T, q_start
        except (OutOfReach, GraspRefused, InvalidProblem):
            continue
    raise DyngraspError(f"{case}: only {drawn} of {trials} draws give a problem")


def _can_begin(planner: CollocationPlanner, targets: GraspTargets, q_start: Array) -> bool:
    """Whether arm and hand stand above the ground at the start, the arm with torque to spare at both ends."""
    task, settings = planner.task, planner.settings
    T = task.robot.forward_kinematics(q_start)
    if T.translation[2] < 0.3:
        return False
    limits = task.robot.limits
    available = 0.95 * (settings.torque_fraction * limits.torque - limits.coriolis)
    loaded, empty = task.robot_loaded(targets.grasp), task.robot_empty
    held = (
        (empty, q_start),
        (empty, targets.pregrasp.position),
        (loaded, targets.grasped.position),
        (loaded, task.place),
    )
    return all((np.abs(robot.gravity_torque(q)) < available).all() for robot, q in held)


def _plan(
    case: str, weight: float, trial: int, planner: CollocationPlanner, T: pin.SE3, q_start: Array, task: GraspTask
) -> list[Stage]:
    """One whole plan as a user gets it, from the pose to the audited plan."""
    began = time.perf_counter()
    targets = grasp_targets(T, task, q_start)
    found = time.perf_counter()
    result = planner.plan(q_start, targets)
    done = time.perf_counter()
    times = {"targets": 1e3 * (found - began)} | {k: v for k, v in result.timings_ms.items() if k != "total"}
    times["rest"] = 1e3 * (done - began) - sum(times.values())
    times["plan"] = 1e3 * (done - began)
    return [Stage(case, weight, trial, name, value, result.ok) for name, value in times.items()]


def _phases(
    case: str,
    weight: float,
    trial: int,
    planner: CollocationPlanner,
    T: pin.SE3,
    q_start: Array,
    task: GraspTask,
    solvers: dict[str, PhaseSolver],
) -> list[Attempt]:
    """The three phases by every solver, each from the same start."""
    targets = grasp_targets(T, task, q_start)
    attempts = []
    for phase, problem in zip(PHASE_NAMES, planner.phase_problems(q_start, targets), strict=True):
        guess = planner.guess(problem, targets)
        for name, solver in solvers.items():
            began = time.perf_counter()
            solution = solver.solve(problem, guess)
            elapsed = 1e3 * (time.perf_counter() - began)
            attempts.append(_attempt(case, weight, trial, phase, name, elapsed, problem, solution))
    return attempts


def _after_a_move(
    case: str, weight: float, trial: int, planner: CollocationPlanner, T: pin.SE3, q_start: Array, task: GraspTask
) -> list[Attempt]:
    """The three phases after the part has moved and the arm has followed, each from its solution before.

    Nothing if the part is then out of reach.
    """
    angle = trial * np.pi * (3 - np.sqrt(5))
    moved = pin.SE3(T.rotation, T.translation + MOVE * np.array([np.cos(angle), np.sin(angle), 0.0]))
    before, attempts = grasp_targets(T, task, q_start), []
    try:
        after = planner.phase_problems(q_start, updated_targets(before, moved, task))
    except DyngraspError:
        return []
    for phase, problem, new in zip(PHASE_NAMES, planner.phase_problems(q_start, before), after, strict=True):
        known = planner.solver.solve(problem, planner.guess(problem, before)).trajectory
        began = time.perf_counter()
        solution = planner.solver.solve(new, known)
        elapsed = 1e3 * (time.perf_counter() - began)
        attempts.append(_attempt(case, weight, trial, phase, WARM, elapsed, new, solution))
    return attempts


def _attempt(
    case: str,
    weight: float,
    trial: int,
    phase: str,
    solver: str,
    time_ms: float,
    problem: PhaseProblem,
    solution: Solution,
) -> Attempt:
    # The violation is measured here for every solver alike, not taken from what it says.
    violation = np.inf if solution.trajectory is None else worst_violation(problem, solution.trajectory)[0]
    numbers = (time_ms, solution.iterations, solution.objective, violation)
    return Attempt(case, weight, trial, phase, solver, *numbers, solution.ok)


def _growth(
    solver: PhaseSolver, trials: int, seed: int, grids: tuple[int, ...], joints: tuple[int, ...]
) -> Iterator[dict[str, Any]]:
    """Nearly time-optimal motions of generated arms under torque rows: more grid points, more joints."""
    seven = serial_chain(7)
    for intervals in grids:
        yield _growth_row(solver, seven, intervals, trials, seed)
    for n in joints:
        yield _growth_row(solver, serial_chain(n), 100, trials, seed)


def _growth_row(solver: PhaseSolver, robot: RobotModel, intervals: int, trials: int, seed: int) -> dict[str, Any]:
    rows = (constraints.torque_rows(robot, intervals),)
    times, iterations, ok = [], [], 0
    for trial in range(-1, trials):
        random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(len(CASES), trial + 1)))
        limits = robot.limits
        ends = random.uniform(0.6 * limits.position_lower, 0.6 * limits.position_upper, (2, robot.n))
        rest = np.zeros(robot.n)
        problem = PhaseProblem(
            name="growth",
            start_position=ends[0],
            start_velocity=rest,
            end_position=ends[1],
            end_velocity=rest,
            position_lower=limits.position_lower,
            position_upper=limits.position_upper,
            velocity_limit=limits.velocity,
            acceleration_limit=limits.acceleration,
            constraints=rows,
            intervals=intervals,
            effort_weight=GROWTH_WEIGHT,
        )
        solution = solver.solve(problem)
        if trial < 0:
            continue  # the first one compiles
        times.append(solution.timings_ms["total"])
        iterations.append(solution.iterations)
        ok += solution.ok
    return {
        "joints": robot.n,
        "intervals": intervals,
        "weight": GROWTH_WEIGHT,
        "ok": ok,
        "iterations": float(np.median(iterations)),
    } | (timing_summary(times))
