"""Trajectories on a uniform grid, and the plan that puts three phases of arm and gripper on one timeline."""

from __future__ import annotations

import itertools
import json
import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dyngrasp.errors import InvalidTrajectory, PlanFileError
from dyngrasp.motion_arrays import (
    JOIN_TOLERANCE,
    PhaseArrays,
    Phases,
    all_finite,
    interpolate,
    largest_defect,
    largest_difference,
    largest_jump,
    make_a_plan,
    write_state,
)
from dyngrasp.signals import Array, JointState, frozen, made, read_only

PHASE_NAMES = ("approach", "grasp", "deliver")


@dataclass(frozen=True)
class Trajectory:
    """A motion ξ on N+1 equidistant grid points that satisfies the trapezoidal rule, eq. (3b).

    Attributes:
        duration: ΔT (s), > 0.
        position: (N+1, n) in rad.
        velocity: (N+1, n) in rad/s.
        acceleration: (N+1, n) in rad/s².

    Raises:
        InvalidTrajectory: Shapes differ, fewer than two grid points, a non-finite number, or a duration ≤ 0.
    """

    duration: float
    position: Array
    velocity: Array
    acceleration: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "duration", float(self.duration))
        q, w, v = read_only(self.position), read_only(self.velocity), read_only(self.acceleration)
        for name, array in (("position", q), ("velocity", w), ("acceleration", v)):
            object.__setattr__(self, name, array)
        if not (q.shape == w.shape == v.shape and q.ndim == 2 and len(q) >= 2):
            shapes = {q.shape, w.shape, v.shape}
            raise InvalidTrajectory(f"position, velocity and acceleration need one shape (N+1, n), N ≥ 1; got {shapes}")
        if not (math.isfinite(self.duration) and self.duration > 0):
            raise InvalidTrajectory(f"duration must be a positive number of seconds, got {self.duration}")
        if not all_finite(q, w, v):
            raise InvalidTrajectory("a trajectory holds finite numbers only")

    @classmethod
    def of(cls, duration: float, motion: Array) -> Trajectory:
        """A trajectory of q, q̇, q̈ in one array (3, N+1, n), just made, that nobody else holds: it becomes read-only."""
        # Not by unpacking: an array that is iterated over ends with an exception and its message.
        return cls(duration, frozen(motion)[0], motion[1], motion[2])

    @property
    def arrays(self) -> PhaseArrays:
        """What compiled code takes for a trajectory: ΔT, q, q̇, q̈."""
        return self.duration, self.position, self.velocity, self.acceleration

    @property
    def intervals(self) -> int:
        """N, the number of grid intervals."""
        return self.position.shape[0] - 1

    @cached_property
    def times(self) -> Array:
        """(N+1,) grid times from 0 to the duration (s)."""
        return read_only(np.linspace(0.0, self.duration, self.intervals + 1))

    def sample(self, t: float) -> JointState:
        """State at one time, clamped to [0, duration]; see `sample_many`."""
        return self.sample_as(t, float(t))

    def sample_as(self, local: float, t: float, at_rest: bool = False) -> JointState:
        """State at `local` (s) under the time `t` (s) of another clock; with velocity and acceleration 0 if at rest."""
        state = np.empty((3, self.position.shape[1]))
        write_state(self.arrays, local, at_rest, state)
        return JointState.of(t, state)

    def sample_many(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """States between the grid points, consistent with the collocation.

        The acceleration is linear between grid points and the velocity its integral: both meet the grid values, for
        that is what the trapezoidal rule says of them. The integral of that velocity misses the grid positions by the
        error of the rule, Δt²/12 (v[k+1] − v[k]); it is spread linearly over the interval, so that the position
        is continuous and exact at the grid points too.

        Args:
            times: (M,) times in seconds, clamped to [0, duration].

        Returns:
            Position, velocity, acceleration, each (M, n), read-only.
        """
        times = np.asarray(times, dtype=float)
        out = np.empty((3, times.size, self.position.shape[1]))
        interpolate(self.arrays, times, out)
        return frozen(out)[0], out[1], out[2]

    def dynamics_defect(self) -> float:
        """Largest violation of the trapezoidal rule, eq. (3b), over all joints and intervals (rad or rad/s)."""
        return largest_defect(self.arrays)


@dataclass(frozen=True)
class PlanSample:
    """State of a plan at one time: the name of the phase, the arm (n joints) and the gripper (m joints)."""

    phase: str
    arm: JointState
    gripper: JointState


@dataclass(frozen=True)
class GraspPlan:
    """Approach, grasp and deliver for arm and gripper on one timeline.

    Attributes:
        arm: Three trajectories of the arm, in the order of `PHASE_NAMES`.
        gripper: Three trajectories of the planned gripper joints; phase by phase of the same duration as the arm's.
        start_time: Time of the first grid point on the common clock (s).
        arm_joints: Names of the n arm joints.
        gripper_joints: Names of the m gripper joints.

    Raises:
        InvalidTrajectory: Arm and gripper differ in duration, or positions or velocities jump at a join.
    """

    arm: tuple[Trajectory, Trajectory, Trajectory]
    gripper: tuple[Trajectory, Trajectory, Trajectory]
    start_time: float
    arm_joints: tuple[str, ...]
    gripper_joints: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("arm", "gripper", "arm_joints", "gripper_joints"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not (len(self.arm) == len(self.gripper) == len(PHASE_NAMES)):
            raise InvalidTrajectory(f"a plan has the phases {PHASE_NAMES} for arm and gripper")
        for phases, joints, what in (
            (self.arm, self.arm_joints, "arm"),
            (self.gripper, self.gripper_joints, "gripper"),
        ):
            for phase, trajectory in zip(PHASE_NAMES, phases, strict=True):
                if trajectory.position.shape[1] != len(joints):
                    raise InvalidTrajectory(
                        f"{what}, phase {phase}: {trajectory.position.shape[1]} columns for {len(joints)} joints"
                    )
        for phases, trajectories, what in zip(self.arrays, (self.arm, self.gripper), ("arm", "gripper"), strict=False):
            if not largest_jump(phases) <= JOIN_TOLERANCE:
                self._refuse_jump(trajectories, what)
        for phase, arm, gripper in zip(PHASE_NAMES, self.arm, self.gripper, strict=True):
            if abs(arm.duration - gripper.duration) > JOIN_TOLERANCE:
                raise InvalidTrajectory(f"phase {phase}: arm takes {arm.duration} s, gripper {gripper.duration} s")

    @classmethod
    def of(
        cls,
        arm: Phases,
        gripper: Phases,
        start_time: float,
        arm_joints: tuple[str, ...],
        gripper_joints: tuple[str, ...],
    ) -> GraspPlan:
        """A plan of `arrays` that nobody can write to, checked in one go: one is made in every replanning cycle.

        Raises:
            InvalidTrajectory: As `Trajectory` and the plan itself.
        """
        if not make_a_plan(arm, gripper, len(arm_joints), len(gripper_joints)):
            # These say what is wrong.
            phases = [tuple(Trajectory(*phase) for phase in phases) for phases in (arm, gripper)]
            return cls(*phases, start_time, arm_joints, gripper_joints)  # type: ignore[arg-type]
        return made(
            cls,
            arm=tuple([_known(*phase) for phase in arm]),
            gripper=tuple([_known(*phase) for phase in gripper]),
            start_time=start_time,
            arm_joints=arm_joints,
            gripper_joints=gripper_joints,
            arrays=(arm, gripper, _ends_of(arm, start_time)),
        )

    @staticmethod
    def _refuse_jump(phases: tuple[Trajectory, ...], what: str) -> None:
        for i in range(len(phases) - 1):
            for name in ("position", "velocity"):
                jump = largest_difference(getattr(phases[i], name)[-1], getattr(phases[i + 1], name)[0])
                if not jump <= JOIN_TOLERANCE:
                    raise InvalidTrajectory(
                        f"{what}: {name} jumps by {jump:.2e} between {PHASE_NAMES[i]} and {PHASE_NAMES[i + 1]}"
                    )

    @cached_property
    def durations(self) -> Array:
        """(3,) durations of the phases (s)."""
        return read_only([phase.duration for phase in self.arm])

    @cached_property
    def phase_ends(self) -> Array:
        """(3,) times T_1, T_2, T_3 at which the phases end, on the common clock (s)."""
        return read_only(self._ends)

    @cached_property
    def arrays(self) -> tuple[Phases, Phases, tuple[float, ...]]:
        """What compiled code takes for a plan: ΔT, q, q̇, q̈ of each phase, of arm and of gripper; T_1, T_2, T_3."""
        arm, gripper = (tuple(trajectory.arrays for trajectory in phases) for phases in (self.arm, self.gripper))
        return arm, gripper, _ends_of(arm, self.start_time)

    @property
    def _ends(self) -> tuple[float, ...]:
        return self.arrays[2]

    @property
    def end_time(self) -> float:
        """Time at which the motion ends (s)."""
        return self._ends[-1]

    def phase_at(self, t: float) -> int:
        """Index of the phase that time `t` falls into; a join belongs to the later phase."""
        return min(bisect_right(self._ends, t), len(PHASE_NAMES) - 1)

    def sample(self, t: float) -> PlanSample:
        """Arm and gripper at time `t` on the common clock, held at the ends of the plan."""
        i = self.phase_at(t)
        local, over = t - (self._ends[i] - self.arm[i].duration), t > self.end_time
        return PlanSample(
            PHASE_NAMES[i], self.arm[i].sample_as(local, t, over), self.gripper[i].sample_as(local, t, over)
        )

    def save(self, path: str | Path) -> None:
        """Write the plan as JSON: per phase times, positions, velocities and accelerations of arm and gripper."""
        document = {
            "format": "dyngrasp.plan",
            "version": 1,
            "start_time": self.start_time,
            "arm_joints": list(self.arm_joints),
            "gripper_joints": list(self.gripper_joints),
            "phases": [
                {
                    "name": name,
                    "duration": arm.duration,
                    "times": (arm.times + end - arm.duration).tolist(),
                    "arm": _to_json(arm),
                    "gripper": _to_json(gripper),
                }
                for name, end, arm, gripper in zip(PHASE_NAMES, self.phase_ends, self.arm, self.gripper, strict=True)
            ],
        }
        Path(path).write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> GraspPlan:
        """Read a plan that `save` wrote; numbers come back exactly.

        Raises:
            PlanFileError: The file is missing, is no such plan, or its trajectories do not make one.
        """
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise PlanFileError(path, None, None, f"cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise PlanFileError(path, None, None, f"is not valid JSON: {error}") from error
        if not isinstance(document, dict) or document.get("format") != "dyngrasp.plan":
            raise PlanFileError(path, "format", None, 'must be "dyngrasp.plan"')
        if document.get("version") != 1:
            raise PlanFileError(path, "version", document.get("version"), "this release reads version 1")
        try:
            phases = document["phases"]
            return cls(
                arm=tuple(_from_json(phase["arm"], phase["duration"]) for phase in phases),  # type: ignore[arg-type]
                gripper=tuple(_from_json(phase["gripper"], phase["duration"]) for phase in phases),  # type: ignore[arg-type]
                start_time=float(document["start_time"]),
                arm_joints=tuple(document["arm_joints"]),
                gripper_joints=tuple(document["gripper_joints"]),
            )
        except KeyError as error:
            raise PlanFileError(path, str(error.args[0]), None, "is missing") from error
        except (TypeError, ValueError, InvalidTrajectory) as error:
            raise PlanFileError(path, None, None, f"does not hold a plan: {error}") from error


def _known(duration: float, position: Array, velocity: Array, acceleration: Array) -> Trajectory:
    """A trajectory of what has been checked."""
    return made(Trajectory, duration=duration, position=position, velocity=velocity, acceleration=acceleration)


def _ends_of(phases: Phases, start_time: float) -> tuple[float, ...]:
    """When phases end that follow one another (s)."""
    return tuple([start_time + passed for passed in itertools.accumulate([phase[0] for phase in phases])])


def _to_json(trajectory: Trajectory) -> dict[str, Any]:
    return {name: getattr(trajectory, name).tolist() for name in ("position", "velocity", "acceleration")}


def _from_json(data: dict[str, Any], duration: float) -> Trajectory:
    return Trajectory(duration, data["position"], data["velocity"], data["acceleration"])
