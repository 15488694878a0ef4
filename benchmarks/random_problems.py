"""Random phases for the structured solver: is every one solved, or reported infeasible and rightly so?

    python benchmarks/random_problems.py --problems 3000 --seed 1 --json random.json

Poses of the part, start postures and velocities, targets, effort weights, torque limits and grids are drawn at random;
some of these problems have no solution. What the solver calls solved is measured apart from it; what it does not solve
is given to IPOPT from the same start and from the solver's own last motion. A thirtieth of what is solved goes to IPOPT
too, for the objective. And what is solved is solved again with its start or its end a little elsewhere, from the motion
before: a start that is known must not make a problem harder than it is.
"""

from __future__ import annotations

import argparse
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin

from dyngrasp.errors import GraspRefused, InvalidProblem, OutOfReach
from dyngrasp.experiments.output import write_json
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.collocation.ipopt import IpoptSettings, IpoptSolver
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.residuals import excess, rows, worst_violation
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import grasp_targets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import PhaseProblem, Status
from dyngrasp.signals import JointState
from dyngrasp.trajectory import Trajectory

PLACE = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])
GRIDS = (20, 50, 100)
COMPARED = 30  # one in so many of the solved ones is solved by IPOPT too
SAME = 1e-5
ELSEWHERE = 0.02  # rad, at most, of each joint: as after a move of the part by a centimetre


def problems(seed: int) -> Iterator[tuple[PhaseProblem, Trajectory | None]]:
    """Phases and where to start them, without end; draws that are no problem at all are left out."""
    random = np.random.default_rng(seed)
    robot, gripper, part = load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting")
    limits = robot.limits
    while True:
        place = (
            random.uniform(0.8 * limits.position_lower, 0.8 * limits.position_upper) if random.random() < 0.5 else PLACE
        )
        task = GraspTask(robot, gripper, part, place)
        q = random.uniform(0.8 * limits.position_lower, 0.8 * limits.position_upper)
        speed = random.uniform(-0.5, 0.5) * (random.random() < 0.5)
        state = JointState(0.0, q, speed * random.uniform(-1, 1, robot.n) * limits.velocity, np.zeros(robot.n))
        radius, angle, yaw = random.uniform(0.45, 0.75), random.uniform(-np.pi, np.pi), random.uniform(-np.pi, np.pi)
        T = pin.SE3(
            pin.utils.rotate("z", yaw), np.array([radius * np.cos(angle), radius * np.sin(angle), part.rest_height])
        )
        settings = CollocationSettings(
            effort_weight=10 ** random.uniform(-4, 1),
            intervals=int(random.choice(GRIDS)),
            torque_fraction=random.uniform(0.4, 1.0),
            velocity_fraction=random.uniform(0.5, 1.0),
        )
        planner = CollocationPlanner(task, settings)
        try:
            targets = grasp_targets(T, task, q)
            phases = planner.phase_problems(state, targets)
        except (GraspRefused, InvalidProblem, OutOfReach):
            continue
        for phase in phases:
            if _stands_at_its_ends(phase):
                yield phase, planner.guess(phase, targets)


def _stands_at_its_ends(problem: PhaseProblem) -> bool:
    """Whether arm and grip could rest at both ends; where they could not, a motion would have to flee at once."""
    ends = np.vstack([problem.start_position, problem.end_position])
    for constraint in problem.constraints:
        at_ends = replace(constraint, parameters=constraint.parameters[[0, -1]])
        if (
            constraint.name in ("torque", "hold")
            and excess(at_ends, rows(at_ends, ends, np.zeros_like(ends))).max() > 0
        ):
            return False
    return True


def elsewhere(problem: PhaseProblem, random: np.random.Generator) -> PhaseProblem | None:
    """The phase with that end a little elsewhere where no part is; None if a limit forbids it or there is none."""
    move = random.uniform(-ELSEWHERE, ELSEWHERE, problem.joints)
    try:
        if problem.name == "approach":
            return replace(problem, start_position=problem.start_position + move)
        if problem.name == "deliver":
            return replace(problem, end_position=problem.end_position + move)
    except InvalidProblem:
        pass
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)

    solver, reference = StructuredSolver(), IpoptSolver(IpoptSettings(max_iterations=300, time_limit=60.0))
    counts: Counter[str] = Counter()
    times, worst, disagreements, change = [], 0.0, [], []
    moves, again = np.random.default_rng(arguments.seed), []
    for index, (problem, guess) in zip(range(arguments.problems), problems(arguments.seed), strict=False):
        solution = solver.solve(problem, guess)
        times.append(solution.timings_ms["total"])
        counts[f"{problem.name}: {solution.status}"] += 1
        if solution.ok:
            worst = max(worst, worst_violation(problem, solution.require())[0])
            if (other := elsewhere(problem, moves)) is not None:
                warm, cold = solver.solve(other, solution.require()), solver.solve(other, guess)
                again.append((warm.ok, cold.ok, warm.iterations, cold.iterations))
            if index % COMPARED == 0 and (other := reference.solve(problem, guess)).ok:
                change.append(solution.objective / other.objective - 1)
            continue
        starts = [guess] + ([solution.trajectory] if solution.trajectory is not None else [])
        solved = any(reference.solve(problem, start).ok for start in starts)
        counts["not solved, IPOPT solves it" if solved else "not solved, nor by IPOPT"] += 1
        if solved or solution.status is not Status.INFEASIBLE:
            disagreements.append(f"{index} {problem.name}: {solution.status}; {solution.message}; IPOPT: {solved}")
    report = {
        "counts": dict(sorted(counts.items())),
        "worst_violation_of_the_solved": worst,
        "ms": dict(zip(("median", "p99", "max"), np.percentile(times, [50, 99, 100]).tolist(), strict=True)),
        "objective_against_ipopt": {
            "compared": len(change),
            "same": sum(abs(c) <= SAME for c in change),
            "better": sum(c < -SAME for c in change),
            "worse": sum(c > SAME for c in change),
        },
        "solved_again": {
            "problems": len(again),
            "from_the_motion_before": sum(warm for warm, *_ in again),
            "from_the_usual_start": sum(cold for _, cold, *_ in again),
            "iterations_from_either": np.median([case[2:] for case in again], axis=0).tolist(),
        },
        "disagreements": disagreements,
    }
    for key, value in report.items():
        print(key, value)
    if arguments.json:
        settings = {"problems": arguments.problems, "seed": arguments.seed}
        write_json(arguments.json, {"settings": settings, "machine": machine(), "versions": versions()} | report)


if __name__ == "__main__":
    main()
