"""What happened in an episode: arrays over time, stored as one compressed .npz file."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.closed_loop.record_file import RecordFormat
from dyngrasp.control.velocity_filter import PAPER_TIME_CONSTANT, VelocityFilter
from dyngrasp.signals import Array, Command, Observation
from dyngrasp.simulation.plant import ContactCategory, Truth
from dyngrasp.trajectory import PHASE_NAMES, PlanSample

FORMAT = RecordFormat("dyngrasp.record", 1, "a record of an episode")


@dataclass(frozen=True, eq=False)
class EpisodeRecord:
    """K samples of an episode with n arm joints and m planned gripper joints; angles in rad, times in s, torques in Nm.

    Attributes:
        arm_joints, gripper_joints: Names.
        t: (K,) times.
        phase: (K,) index of the plan's phase; that of the approach also while the arm waits for a first look.
        arm_planned, arm_planned_velocity: (K, n) what the plan asked for.
        arm_measured: (K, n) encoder positions.
        arm_filtered_velocity: (K, n) their velocities through the differential filter.
        arm_velocity: (K, n) true velocities.
        arm_torque_commanded, arm_torque_applied: (K, n) before and after saturation in the plant.
        gripper_planned, gripper_measured: (K, m) positions.
        gripper_torque_commanded, gripper_torque_applied: (K, m).
        part_position, part_quat_wxyz: (K, 3), (K, 4) true pose of the object frame.
        support_position: (K, 3) how far what the part stood on at first has moved.
        hand_position, hand_quat_wxyz: (K, 3), (K, 4) true pose of the hand frame.
        grasp_point: (K, 3) true midpoint of the two pads, world frame.
        pad_force: (K, pads) normal force between each pad and the part (N).
        contacts: (K, 5) bool by `ContactCategory`: whether it occurred at any control period since the sample before.
        scene_state: (K, ·) generalised positions for the renderer.
        meta: Whatever else belongs to it: seed, versions, scenario.
    """

    arm_joints: tuple[str, ...]
    gripper_joints: tuple[str, ...]
    t: Array
    phase: NDArray[np.int_]
    arm_planned: Array
    arm_planned_velocity: Array
    arm_measured: Array
    arm_filtered_velocity: Array
    arm_velocity: Array
    arm_torque_commanded: Array
    arm_torque_applied: Array
    gripper_planned: Array
    gripper_measured: Array
    gripper_torque_commanded: Array
    gripper_torque_applied: Array
    part_position: Array
    part_quat_wxyz: Array
    support_position: Array
    hand_position: Array
    hand_quat_wxyz: Array
    grasp_point: Array
    pad_force: Array
    contacts: NDArray[np.bool_]
    scene_state: Array
    meta: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ARRAY_NAMES:
            array = np.array(getattr(self, name))
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        lengths = {name: len(getattr(self, name)) for name in ARRAY_NAMES}
        if len(set(lengths.values())) != 1:
            raise ValueError(f"every array of a record has one entry a sample; got {lengths}")

    def __len__(self) -> int:
        """Number of samples K."""
        return len(self.t)

    def T_world_part(self, k: int) -> pin.SE3:
        """True pose of the part at sample k."""
        return _pose(self.part_position[k], self.part_quat_wxyz[k])

    def T_world_hand(self, k: int) -> pin.SE3:
        """True pose of the hand at sample k."""
        return _pose(self.hand_position[k], self.hand_quat_wxyz[k])

    def index_at(self, t: float) -> int:
        """The first sample at or after time t, the last one if there is none."""
        return int(min(np.searchsorted(self.t, t - 1e-9), len(self) - 1))

    def touched(self, category: ContactCategory) -> NDArray[np.bool_]:
        """(K,) whether there was such a contact."""
        return self.contacts[:, category]

    def save(self, path: str | Path) -> None:
        """Write everything into one compressed .npz file, exactly at `path`."""
        header = {"arm_joints": self.arm_joints, "gripper_joints": self.gripper_joints, "meta": self.meta}
        FORMAT.write(path, header, {name: getattr(self, name) for name in ARRAY_NAMES})

    @classmethod
    def load(cls, path: str | Path) -> EpisodeRecord:
        """Read a record that `save` wrote; nothing in the file is executed.

        Raises:
            InputFileError: The file is missing, is no record, or lacks an array or a name.
        """
        with FORMAT.opened(path) as (header, archive):
            arrays = {name: archive[name] for name in ARRAY_NAMES}
            return cls(tuple(header["arm_joints"]), tuple(header["gripper_joints"]), **arrays, meta=header["meta"])


ARRAY_NAMES = tuple(f.name for f in fields(EpisodeRecord) if f.name not in ("arm_joints", "gripper_joints", "meta"))
"""The arrays of a record, in the order of its fields."""


class Recorder:
    """Collects samples while an episode runs.

    Args:
        arm_joints, gripper_joints: Names.
        dt: Control period (s); `watch` is to be called once in each.
    """

    def __init__(self, arm_joints: tuple[str, ...], gripper_joints: tuple[str, ...], dt: float) -> None:
        self._names = arm_joints, gripper_joints
        self._filter = VelocityFilter(PAPER_TIME_CONSTANT, dt)
        self._velocity = np.zeros(len(arm_joints))
        self._contacts = np.zeros(len(ContactCategory), dtype=bool)
        self._rows: list[tuple[Any, ...]] = []

    def watch(self, observation: Observation, truth: Truth) -> None:
        """Follow what must not be missed between two samples: encoder positions and contacts."""
        self._velocity = self._filter.update(observation.arm_position)
        self._contacts |= np.array(truth.contacts)

    def sample(
        self, observation: Observation, truth: Truth, plan: PlanSample, command: Command, applied: Command, state: Array
    ) -> None:
        """Keep this instant. `applied` are the torques after saturation, `state` the positions for the renderer."""
        part, hand = truth.T_world_part, truth.T_world_hand
        self._rows.append(
            (
                observation.t,
                PHASE_NAMES.index(plan.phase),
                plan.arm.position,
                plan.arm.velocity,
                observation.arm_position,
                self._velocity,
                truth.arm_velocity,
                command.arm_torque,
                applied.arm_torque,
                plan.gripper.position,
                observation.gripper_position,
                command.gripper_torque,
                applied.gripper_torque,
                part.translation.copy(),
                _quat_wxyz(part),
                truth.p_world_support,
                hand.translation.copy(),
                _quat_wxyz(hand),
                truth.p_world_grasp_point,
                truth.pad_force,
                self._contacts,
                state,
            )
        )
        self._contacts = np.zeros_like(self._contacts)

    def finish(self, meta: dict[str, Any] | None = None) -> EpisodeRecord:
        """The record of everything kept."""
        columns = (np.array(column) for column in zip(*self._rows, strict=True))
        return EpisodeRecord(*self._names, *columns, meta=dict(meta or {}))


def _pose(position: Array, quat_wxyz: Array) -> pin.SE3:
    w, x, y, z = quat_wxyz
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.array(position))


def _quat_wxyz(T: pin.SE3) -> Array:
    x, y, z, w = pin.Quaternion(T.rotation).coeffs()
    return np.array([w, x, y, z])
