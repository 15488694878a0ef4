"""Random replans without end: is anything ever published that fails the audit, jumps, or was made for another pose?

    python benchmarks/fuzz_replans.py --count 10000 --seed 1 --json fuzz.json

Each chain starts from a plan of one of several cells (both weights, generous and tight limits of speed and torque) and
replans it up to six times in a row, each time from a random moment of what then runs: a little beside the last pose,
far from it, anywhere in the paper's box, or moving at up to 0.1 m/s. Deadlines are not kept, so that every way is
taken. What is published is audited again, here, with the wall of the funnel as the result says that it was softened.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from dyngrasp.errors import PlanningFailed
from dyngrasp.experiments.bench_replan import START_DEG, Cell, make_cell, splice_jump
from dyngrasp.experiments.output import write_json
from dyngrasp.experiments.provenance import machine, versions
from dyngrasp.planning.audit import audit
from dyngrasp.planning.collocation.planner import CollocationPlanner
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets, moved
from dyngrasp.planning.replanning.funnel_recovery import FunnelRecovery
from dyngrasp.planning.replanning.replanner import Replanner, ReplanResult
from dyngrasp.planning.worst_values import WHOLE
from dyngrasp.signals import PoseEstimate
from dyngrasp.trajectory import GraspPlan

LONGEST_CHAIN = 6
JUMP = 1e-9  # rad, rad/s, rad/s²


def tightened(cell: Cell, speed: float, torque: float) -> Cell:
    """The same cell with an arm that can do less, and a plan of its own."""
    limits = cell.task.robot.limits
    tight = replace(limits, velocity=speed * limits.velocity, torque=torque * limits.torque)
    task = replace(cell.task, robot=replace(cell.task.robot, limits=tight))
    planner = CollocationPlanner(task, cell.planner.settings)
    q_start = np.deg2rad(START_DEG)
    targets = grasp_targets(cell.targets.T_world_object, task, q_start)
    return Cell(task, targets, planner.plan(q_start, targets).require(), planner)


def cells() -> list[Cell]:
    """Where chains begin."""
    easy = [make_cell(rho, yaw) for rho, yaw in itertools.product((1.0, 0.1), (0.3, -1.2, 2.4))]
    found = list(easy)
    for cell in easy:
        try:
            found.append(tightened(cell, 0.5, 0.6))
        except PlanningFailed:
            continue
    return found


def draw(targets: GraspTargets, t: float, rng: np.random.Generator) -> tuple[str, PoseEstimate]:
    """A new estimate of the part's pose."""
    kind = str(rng.choice(["near", "far", "anywhere", "moving"], p=[0.4, 0.2, 0.2, 0.2]))
    T, twist = targets.T_world_object_at(t), targets.twist_world.copy()
    distance, angle = {"near": (0.03, 0.2), "far": (0.15, 1.0), "anywhere": (0.0, 0.0), "moving": (0.05, 0.3)}[kind]
    if kind == "anywhere":
        T = pin.SE3(pin.utils.rotate("z", rng.uniform(-np.pi, np.pi)), T.translation)
        T.translation[:2] = rng.uniform([0.6, -0.1], [0.7, 0.1])
    offset = distance * rng.uniform() * _direction(rng)
    T = pin.SE3(pin.utils.rotate("z", angle * rng.uniform(-1, 1)) @ T.rotation, T.translation + offset)
    if kind == "moving":
        twist = np.append(rng.uniform(0.0, 0.1) * _direction(rng), [0.0, 0.0, rng.uniform(-0.1, 0.1)])
    return kind, PoseEstimate(T, 1e-6 * np.eye(6), t, t, twist)


def offences(running: GraspPlan, result: ReplanResult, estimate: PoseEstimate, replanner: Replanner) -> list[str]:
    """What is wrong with a published plan; nothing, it is hoped."""
    found = []
    jump = splice_jump(running, result)
    if not jump <= JUMP:
        found.append(f"jump of {jump:.1e}")
    softened = FunnelRecovery(result.recovery, replanner.settings.recovery_shares).wall(result.plan)
    # Of a plan that is past its pre-grasp the wall is whole.
    wall = softened if result.plan.start_time == result.splice else WHOLE
    report = audit(result.plan, result.targets, replanner.task, result.splice, wall)
    found += [f"{entry.name}" for entry in report.failures]
    if result.audit is None or not result.audit.ok:
        found.append("no passed audit attached")
    moving = np.abs(estimate.twist_world).max() > replanner.settings.settled
    met = float(result.plan.phase_ends[1]) if moving else estimate.t_capture
    expected = moved(estimate.T_world_object, estimate.twist_world, met - estimate.t_capture)
    miss = float(np.abs(result.targets.T_world_object.translation - expected.translation).max())
    if miss > 1e-5:
        found.append(f"made for a pose {1e3 * miss:.2f} mm off")
    return found


def main() -> int:
    """Run the chains and say what came of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="replans")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    starts = cells()
    replanners = [Replanner(cell.task, None, StructuredSolver(), cell.planner, lambda: 0.0) for cell in starts]
    outcomes: Counter[tuple[str, str]] = Counter()
    reasons: Counter[str] = Counter()
    offending: list[dict] = []
    worst_jump, done, began = 0.0, 0, time.perf_counter()
    while done < options.count:
        which = int(rng.integers(len(starts)))
        replanner, plan, targets = replanners[which], starts[which].plan, starts[which].targets
        t = plan.start_time
        for _ in range(int(rng.integers(1, LONGEST_CHAIN + 1))):
            # Anywhere on what is left, most of it before the fingers close: afterwards nothing may change.
            t = max(t, plan.start_time) + rng.uniform() * max(float(plan.phase_ends[1]) - t, 0.0)
            kind, estimate = draw(targets, t, rng)
            result = replanner.replan_to_pose(plan, targets, estimate, t)
            done += 1
            outcomes[kind, str(result.path) if result.ok else f"kept: {result.status}"] += 1
            if done % 1000 == 0:
                print(f"{done} replans, {len(offending)} offences", flush=True)
            if not result.ok:
                reasons[_words(result.message)] += 1
                continue
            worst_jump = max(worst_jump, splice_jump(plan, result))
            if found := offences(plan, result, estimate, replanner):
                offending.append({"replan": done, "kind": kind, "path": str(result.path), "offences": found})
                print(offending[-1], flush=True)
            plan, targets = result.plan, result.targets
    for (kind, outcome), count in sorted(outcomes.items()):
        print(f"{kind:9} {outcome:24} {count}")
    for words, count in reasons.most_common(12):
        print(f"{count:6}  {words}")
    published = sum(count for (_, outcome), count in outcomes.items() if not outcome.startswith("kept"))
    elapsed = time.perf_counter() - began
    print(
        f"{done} replans in {elapsed:.0f} s from {len(starts)} cells: {published} published, {len(offending)} of them "
        f"offend; largest jump at a splice {worst_jump:.1e}"
    )
    if options.json:
        document = {
            "count": done,
            "seed": options.seed,
            "outcomes": [{"kind": k, "outcome": o, "count": n} for (k, o), n in sorted(outcomes.items())],
            "reasons": dict(reasons),
            "published": published,
            "offending": offending,
            "largest_jump": worst_jump,
        }
        write_json(options.json, document | {"machine": machine(), "versions": versions()})
    return 1 if offending else 0


def _direction(rng: np.random.Generator) -> np.ndarray:
    heading = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(heading), np.sin(heading), 0.0])


def _words(message: str) -> str:
    """The last reason without its numbers."""
    last = message.rsplit("; ", 1)[-1]
    return " ".join(word for word in last.split() if not any(letter.isdigit() for letter in word))[:100]


if __name__ == "__main__":
    sys.exit(main())
