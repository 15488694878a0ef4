"""Follow a part with a pose source of one's own: a tracking camera beside the robot, 40 ms late."""

from collections import deque
from pathlib import Path

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.draws import draw_trial
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.trial import execute_trial, plan_trial, planner_for
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth


class TrackingCamera:
    """A `PoseSource` is whatever has this method `estimate`: asked at the replanner's rate, it says what it knows.

    This one simulates a sensor, so it may look at the truth. One that talks to a real sensor leaves `truth` alone.
    """

    DELAY = 0.04
    DEVIATION = np.repeat([1e-3, np.deg2rad(0.3)], 3)  # of one frame, per axis: m, rad

    def __init__(self, believed: pin.SE3, seed: int):
        wide = np.diag(np.repeat([0.03, np.deg2rad(10.0)], 3) ** 2)
        self.filter = PoseFilter(PoseFilterSettings.still(), prior=PoseEstimate(believed, wide, 0.0, 0.0))
        self.rng = np.random.default_rng(seed)
        self.on_the_way: deque[PoseEstimate] = deque()

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        noisy = truth.T_world_part * pin.exp6(self.DEVIATION * self.rng.normal(size=6))
        self.on_the_way.append(PoseEstimate(noisy, np.diag(self.DEVIATION**2), t, t + self.DELAY))
        while self.on_the_way[0].t_receipt <= t:
            self.filter.update(self.on_the_way.popleft(), now=t)
        return self.filter.estimate(t)


# The part is believed 20 mm and 5 degrees beside where it stands, so that the first plan would miss it.
scenario = Path(__file__).parent.parent / "scenarios" / "replan_20mm.toml"
workcell = load_workcell(load_scenario(scenario, ["replanner.rate_hz=20"]), scenario)
trial = draw_trial(workcell, seed=1)
planner = planner_for(workcell)
planned = plan_trial(workcell, trial, planner)

source = TrackingCamera(planned.targets.T_world_object, seed=1)
executed = execute_trial(workcell, trial, planned, planner=planner, source=source)

published = [event for event in executed.replans if event.result.ok]
print(
    f"{len(published)} plans replaced the first one; {len(executed.not_taken)} poses were too uncertain to be followed"
)
before, after = (
    T.actInv(trial.T_world_object) for T in (planned.targets.T_world_object, executed.targets.T_world_object)
)
for name, error in (("at first", before), ("in the end", after)):
    print(f"pose error {name}: {1e3 * np.linalg.norm(error.translation):.1f} mm")
print("delivered" if executed.outcome.success else f"not delivered: {executed.outcome.cause}")
raise SystemExit(not executed.outcome.success)
