"""The plant in MuJoCo: torques in, encoder positions and pad forces out."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from dyngrasp.signals import Array, Command, Observation
from dyngrasp.simulation.plant import ContactCategory, PlantDiverged, Truth
from dyngrasp.simulation.scene import Scene

# Category of a contact by the kinds of its two geoms (0 ground, 1 part, 2 pad, 3 the rest of the robot).
_CATEGORY = {
    (0, 1): ContactCategory.PART_GROUND,
    (0, 2): ContactCategory.ROBOT_GROUND,
    (0, 3): ContactCategory.ROBOT_GROUND,
    (1, 2): ContactCategory.PADS_PART,
    (1, 3): ContactCategory.OTHER_ROBOT_PART,
    (2, 2): ContactCategory.ROBOT_ROBOT,
    (2, 3): ContactCategory.ROBOT_ROBOT,
    (3, 3): ContactCategory.ROBOT_ROBOT,
}
_CATEGORY_TABLE = np.full((4, 4), -1)
for (_a, _b), _category in _CATEGORY.items():
    _CATEGORY_TABLE[_a, _b] = _CATEGORY_TABLE[_b, _a] = _category

_FATAL = np.array(
    [
        mujoco.mjtWarning.mjWARN_CONTACTFULL,
        mujoco.mjtWarning.mjWARN_CNSTRFULL,
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    ],
    dtype=int,
)

if mujoco.get_mju_user_warning() is None:
    # MuJoCo's own habit is to write MUJOCO_LOG.TXT into whatever folder the user works in.
    mujoco.set_mju_user_warning(logging.getLogger(__name__).warning)


@dataclass(frozen=True)
class SensorSettings:
    """Imperfections of the encoders; none by default.

    Attributes:
        encoder_step: Quantisation (rad), 0 for none. The arm's own encoders resolve far below 1e-5 rad.
        encoder_noise: Standard deviation of white noise (rad).
        seed: Of that noise.
    """

    encoder_step: float = 0.0
    encoder_noise: float = 0.0
    seed: int = 0


class MujocoPlant:
    """Implements `Plant`, and `truth` for the record.

    Args:
        scene: The compiled world; several plants may share it, each has a state of its own.
        arm_position: (n,) where the arm starts, at rest (rad).
        gripper_position: (m,) where the planned gripper joints start, at rest (rad).
        T_world_part: Where the part lies, at rest on what it stands on.
        sensors: Imperfections of the sensors.
        t: Time at the start (s).
    """

    def __init__(
        self,
        scene: Scene,
        arm_position: ArrayLike,
        gripper_position: ArrayLike,
        T_world_part: pin.SE3,
        *,
        sensors: SensorSettings | None = None,
        t: float = 0.0,
    ) -> None:
        self.scene = scene
        self._data = mujoco.MjData(scene.model)
        self._sensors = sensors or SensorSettings()
        self._rng = np.random.default_rng(self._sensors.seed)
        data = self._data
        data.time = t
        data.qpos[scene.arm_qpos] = np.asarray(arm_position, dtype=float)
        data.qpos[scene.gripper_qpos] = np.asarray(gripper_position, dtype=float)
        data.qpos[scene.locked_qpos] = scene.locked_position
        x, y, z, w = pin.Quaternion(T_world_part.rotation).coeffs()
        data.qpos[scene.part_qpos : scene.part_qpos + 7] = [*T_world_part.translation, w, x, y, z]
        n, m = scene.arm_qpos.size, scene.gripper_qpos.size
        locked = n + m + scene.locked_qpos.size
        self._arm, self._gripper, self._locked = slice(0, n), slice(n, n + m), slice(n + m, locked)
        data.ctrl[self._locked] = scene.locked_position
        if scene.conveyor is not None:
            # What runs at the start ran before, and the part with it.
            data.ctrl[scene.conveyor.actuator] = scene.conveyor.conveyor.speed_at(t)
            data.qvel[scene.conveyor.dof] = scene.conveyor.conveyor.speed_at(t)
            data.qvel[scene.part_dof : scene.part_dof + 6] = scene.conveyor.conveyor.twist_at(t)
        mujoco.mj_forward(scene.model, data)
        self._observed_at = -1.0
        self._observation: Observation | None = None

    @property
    def t(self) -> float:
        """Time (s)."""
        return float(self._data.time)

    @property
    def state(self) -> Array:
        """All generalised positions as MuJoCo orders them, for the renderer."""
        return self._data.qpos.copy()

    def observe(self) -> Observation:
        """Encoder positions and pad forces. Reading twice at one time gives the same answer, noise included."""
        if self._observation is None or self._observed_at != self.t:
            scene = self.scene
            self._observation = Observation(
                self.t,
                self._encode(self._data.qpos[scene.arm_qpos]),
                self._encode(self._data.qpos[scene.gripper_qpos]),
                self._pad_force(part_only=False),
            )
            self._observed_at = self.t
        return self._observation

    def step(self, command: Command) -> None:
        """Apply torques, saturated at what the motors can give, for one time step.

        Raises:
            PlantDiverged: A torque that is not finite, or a simulation that became unstable or ran out of memory.
        """
        scene, data = self.scene, self._data
        data.ctrl[self._arm] = np.clip(command.arm_torque, -scene.arm_torque_limit, scene.arm_torque_limit)
        limit = scene.gripper_torque_limit
        data.ctrl[self._gripper] = np.clip(command.gripper_torque, -limit, limit)
        if scene.conveyor is not None:
            data.ctrl[scene.conveyor.actuator] = scene.conveyor.conveyor.speed_at(self.t)
        if not np.isfinite(data.ctrl).all():
            raise PlantDiverged(f"a torque that is not finite was commanded at {self.t:.4f} s")
        mujoco.mj_step(scene.model, data)
        if data.warning.number[_FATAL].any():
            what = mujoco.mju_warningText(int(_FATAL[data.warning.number[_FATAL].argmax()]), 0)
            raise PlantDiverged(f"simulation failed at {self.t:.4f} s: {what}")

    @property
    def applied(self) -> Command:
        """Torques that the motors gave in the last step (Nm), after saturation; zeros before the first."""
        return Command(self._data.actuator_force[self._arm], self._data.actuator_force[self._gripper])

    def truth(self) -> Truth:
        """See `Truth`. Contacts and forces are those at the start of the last step, as MuJoCo computes them."""
        scene, data = self.scene, self._data
        q = data.qpos[scene.part_qpos : scene.part_qpos + 7]
        v = data.qvel[scene.part_dof : scene.part_dof + 6]
        R_world_part = pin.Quaternion(q[3], q[4], q[5], q[6]).normalized().matrix()
        T_world_part = pin.SE3(R_world_part, q[:3].copy())
        hand = scene.hand_body
        T_world_hand = pin.SE3(data.xmat[hand].reshape(3, 3).copy(), data.xpos[hand].copy())
        kinds = scene.geom_kind[data.contact.geom]
        support = np.zeros(3)
        if scene.conveyor is not None:
            support = data.qpos[scene.conveyor.qpos] * scene.conveyor.conveyor.direction
        present = set(_CATEGORY_TABLE[kinds[:, 0], kinds[:, 1]].tolist())
        return Truth(
            t=self.t,
            T_world_part=T_world_part,
            # MuJoCo gives the angular velocity of a free joint in body axes.
            part_twist=np.concatenate([v[:3], R_world_part @ v[3:]]),
            p_world_support=support,
            T_world_hand=T_world_hand,
            p_world_grasp_point=data.site_xpos[scene.pad_sites].mean(axis=0),
            arm_position=data.qpos[scene.arm_qpos],
            arm_velocity=data.qvel[scene.arm_dof],
            gripper_position=data.qpos[scene.gripper_qpos],
            gripper_velocity=data.qvel[scene.gripper_dof],
            pad_force=self._pad_force(part_only=True),
            contacts=tuple(category in present for category in ContactCategory),
        )

    def _encode(self, position: Array) -> Array:
        if self._sensors.encoder_noise > 0:
            position = position + self._rng.normal(0.0, self._sensors.encoder_noise, position.shape)
        if self._sensors.encoder_step > 0:
            position = np.round(position / self._sensors.encoder_step) * self._sensors.encoder_step
        return position

    def _pad_force(self, *, part_only: bool) -> Array:
        """Sum of the normal forces on each pad; a tactile pad cannot tell what it touches, the truth can."""
        data, scene = self._data, self.scene
        geoms = data.contact.geom
        force = np.zeros(scene.pad_geoms.size)
        if not len(geoms):
            return force
        address = data.contact.efc_address
        for i, pad in enumerate(scene.pad_geoms):
            on_pad = (geoms == pad).any(axis=1) & (address >= 0)
            if part_only:
                on_pad &= (scene.geom_kind[geoms] == 1).any(axis=1)
            # With elliptic cones the first row of a contact is its normal force.
            force[i] = data.efc_force[address[on_pad]].sum()
        return force
