"""Does memory grow with the number of solves?

    python benchmarks/many_solves.py --solves 100000

Prints the peak memory of the process as solves go on, new problems all the time: after the first tenth it should stay.
"""

from __future__ import annotations

import argparse
import resource

import numpy as np
import pinocchio as pin

from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import grasp_targets
from dyngrasp.planning.grasp_task import GraspTask

Q_START = np.deg2rad([55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0])
PLACE = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solves", type=int, default=100_000)
    arguments = parser.parse_args()
    task, solver = (
        GraspTask(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"), PLACE),
        StructuredSolver(),
    )
    planners = [CollocationPlanner(task, CollocationSettings(effort_weight=weight), solver) for weight in (1.0, 1e-3)]
    random, solves, reported = np.random.default_rng(0), 0, 0
    while solves < arguments.solves:
        x, y, yaw = random.uniform(0.6, 0.7), random.uniform(-0.1, 0.1), random.uniform(-np.pi, np.pi)
        T = pin.SE3(pin.utils.rotate("z", yaw), np.array([x, y, task.grasp_object.rest_height]))
        targets = grasp_targets(T, task, Q_START)
        # Mostly the cheap weight: what is looked for is memory, not time.
        planner = planners[int(random.random() < 0.02)]
        for problem in planner.phase_problems(Q_START, targets):
            solution = solver.solve(problem, planner.guess(problem, targets))
            # A solution as a start takes the way through kept multipliers.
            if solution.trajectory is not None and random.random() < 0.05:
                solver.solve(problem, solution.trajectory)
                solves += 1
            solves += 1
        if solves >= (reported + 1) * arguments.solves // 10:
            reported = 10 * solves // arguments.solves
            # Linux counts in KiB, macOS in bytes.
            print(f"{solves} solves: peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}", flush=True)


if __name__ == "__main__":
    main()
