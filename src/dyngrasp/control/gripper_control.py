"""Control of the hand: position until the part is between the pads, then force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.control.velocity_filter import PAPER_TIME_CONSTANT, VelocityFilter
from dyngrasp.models.gripper import GripperModel
from dyngrasp.signals import Array, Observation
from dyngrasp.trajectory import PlanSample


@dataclass(frozen=True)
class GripperControlSettings:
    """Gains and forces of the hand controller.

    Attributes:
        bandwidth: ω of each joint about its own inertia (rad/s); higher rings against the differential filter.
        damping: ζ.
        contact_force: Pad force that counts as contact (N): above what a bump of the tactile signal gives, well below
            a pinch.
        over_close: How far the pads are asked to go beyond where the plan closes them (m, each): it keeps the position
            loop pressing, and lets the second pad reach a part that lies off its expected place by as much; more would
            leave the loop saturated, and a saturated loop has no stiffness against sideways forces.
        force_fraction: Share of the torque limit that the squeeze takes; the rest is left to the position loop, which
            holds the part sideways.
        ramp: Time over which the squeeze rises (s). At once, it would kick the part; slower, the lift begins before it.
        velocity_time_constant: T₁ of the differential filter (s).
    """

    bandwidth: float = 50.0
    damping: float = 0.8
    contact_force: float = 0.5
    over_close: float = 1.5e-3
    force_fraction: float = 0.8
    ramp: float = 0.08
    velocity_time_constant: float = PAPER_TIME_CONSTANT


class GripperController:
    """PD about the planned posture, with the fingers' inertia, damping and weight fed forward; a squeeze after contact.

    From the first touch of a pad on, the planned gap is reduced by `over_close` on each side, so that the other pad
    comes to the part too. Once every pad feels it, a feed-forward that presses the pads together along the closing axis
    ramps up. Both begin when the planned closing has ended, whatever the pads feel. What the held part asks for along
    the closing axis, its weight where the hand is tilted, is fed forward too: one pad presses more, the other less.
    Torques never pass the limits of the hand.

    Args:
        gripper: The hand.
        dt: Control period (s).
        held_mass: What the part is believed to weigh (kg).
        settings: Gains and forces.
    """

    def __init__(
        self, gripper: GripperModel, dt: float, held_mass: float = 0.0, settings: GripperControlSettings | None = None
    ) -> None:
        self.settings = settings or GripperControlSettings()
        self._gripper, self._held_mass = gripper, held_mass
        self._model = pin.Model(gripper.pin_model)
        self._data = self._model.createData()
        self._columns = np.array([self._model.joints[self._model.getJointId(j)].idx_v for j in gripper.joint_names])
        self._inertia = np.diag(self._mass_matrix(gripper.open_posture)).copy()
        self._joint_damping = np.array(gripper.pin_model.damping)[self._columns]
        self._filter = VelocityFilter(self.settings.velocity_time_constant, dt)
        self._planned = VelocityFilter(self.settings.velocity_time_constant, dt)
        self._touch_since: float | None = None
        self._squeeze_since: float | None = None
        self.velocity = np.zeros(gripper.m)

    @property
    def squeezing(self) -> bool:
        """Whether the hand presses."""
        return self._squeeze_since is not None

    def command(self, observation: Observation, sample: PlanSample, specific_force: Array) -> Array:
        """Torques for this control period.

        Args:
            observation: Joint positions and pad forces now.
            sample: What the plan asks for now.
            specific_force: (3,) acceleration of the hand minus that of gravity, in hand axes (m/s²): what an
                accelerometer in the palm would read, and what the fingers weigh by.

        Returns:
            (m,) torques within the limits (Nm).
        """
        s, plan, gripper = self.settings, sample.gripper, self._gripper
        q = observation.gripper_position
        self.velocity = self._filter.update(q)
        self._watch_contact(observation, sample)
        target, squeeze = np.array(plan.position), np.zeros(gripper.m)
        if self._touch_since is not None:
            target = target + self._share(self._touch_since, sample.gripper.t) * self._over_closing(target)
        if self._squeeze_since is not None:
            squeeze = self._share(self._squeeze_since, sample.gripper.t) * self._squeeze_torque(q, specific_force)
        error = target - q
        error_rate = self._planned.update(target) - self.velocity
        feedback = s.bandwidth**2 * error + 2 * s.damping * s.bandwidth * error_rate
        torque = self._inertia * (plan.acceleration + feedback) + self._joint_damping * plan.velocity
        torque += self._weight(q, specific_force) + squeeze
        return np.clip(torque, -gripper.torque, gripper.torque)

    def _watch_contact(self, observation: Observation, sample: PlanSample) -> None:
        if sample.phase == "approach":
            self._touch_since = self._squeeze_since = None
            return
        touched = observation.pad_force > self.settings.contact_force
        ended = sample.phase == "deliver"
        if self._touch_since is None and (touched.any() or ended):
            self._touch_since = sample.gripper.t
        if self._squeeze_since is None and (touched.all() or ended):
            self._squeeze_since = sample.gripper.t

    def _share(self, since: float, t: float) -> float:
        return min((t - since) / self.settings.ramp, 1.0)

    def _over_closing(self, posture: Array) -> Array:
        """(m,) step along the closing motion that brings each pad `over_close` further (rad)."""
        gripper = self._gripper
        direction = gripper.closed_posture - gripper.open_posture
        small = 1e-4
        slope = (gripper.aperture(posture + small * direction) - gripper.aperture(posture)) / small
        return direction * (-2 * self.settings.over_close / slope)

    def _squeeze_torque(self, q: Array, specific_force: Array) -> Array:
        """(m,) J_padᵀ F: presses both pads together, the weakest joint at `force_fraction` of its limit.

        The difference of the two forces carries the part along the closing axis.
        """
        gripper = self._gripper
        first, second = self._torque_per_newton(q)
        scale = self.settings.force_fraction / np.max(np.abs(first + second) / gripper.torque)
        force = min(scale, gripper.pinch_force)
        # The first pad presses against the closing axis.
        sideways = self._held_mass * float(specific_force @ gripper.closing_axis) / 2
        return (force - sideways) * first + (force + sideways) * second

    def _torque_per_newton(self, q: Array) -> list[Array]:
        """For each pad the (m,) torques that press it with 1 N along the closing axis, towards the other one."""
        gripper, torques = self._gripper, []
        pin.computeJointJacobians(self._model, self._data, gripper.full_configuration(q))
        pin.updateFramePlacements(self._model, self._data)
        for side, frame in zip((-1.0, 1.0), gripper.pad_ids, strict=True):
            inward = side * gripper.closing_axis
            J = pin.getFrameJacobian(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED)[:, self._columns]
            # The pads touch at the foot of their arcs on the part: arc centre plus radius along the closing axis.
            torques.append((J[:3] - pin.skew(gripper.pad_radius * inward) @ J[3:]).T @ inward)
        return torques

    def _weight(self, q: Array, specific_force: Array) -> Array:
        self._model.gravity.linear = -specific_force
        weight = pin.computeGeneralizedGravity(self._model, self._data, self._gripper.full_configuration(q))
        return weight[self._columns].copy()

    def _mass_matrix(self, q_h: Array) -> Array:
        upper = np.triu(pin.crba(self._model, self._data, self._gripper.full_configuration(q_h)))
        return (upper + np.triu(upper, 1).T)[np.ix_(self._columns, self._columns)]
