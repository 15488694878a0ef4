"""Computed-torque control of the arm: feed-forward from the plan, feedback in units of acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyngrasp.control.velocity_filter import PAPER_TIME_CONSTANT, VelocityFilter
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array, Observation
from dyngrasp.trajectory import PlanSample


@dataclass(frozen=True)
class ComputedTorqueSettings:
    """Gains of the arm controller.

    The feedback law acts on a double integrator, whatever the joint: a = q̈_plan + K_p e + K_d ė + K_i ∫e. Its gains are
    set by bandwidth ω, damping ζ and the ratio K_i/K_p. The differential filter costs phase; with ω = 30 rad/s, ζ = 1,
    ratio 10 the sensitivity stays below 2.2 for effective inertias 20 % off, and a step of 1 rad/s² (dry friction
    that changes sign) costs 0.75 mrad. Faster loops ring against the filter.

    Attributes:
        bandwidth: ω (rad/s), K_p = ω².
        damping: ζ, K_d = 2 ζ ω.
        integral_ratio: K_i / K_p (1/s).
        friction_adaptation: Gain of the learnt joint friction (1/s): how fast the viscous and dry friction estimated
            from the tracking error follow it; 0 switches the estimate off. Dry friction flips its sign with the
            velocity, just at the grasp; an integrator needs a tenth of a second to turn round, the estimate none.
        stick_speed: Speed below which the learnt dry friction fades (rad/s), so that it does not chatter.
        payload_ramp: Time over which the loaded model takes over after the grasp (s): that of the fingers' squeeze.
        velocity_time_constant: T₁ of the differential filter (s).
    """

    bandwidth: float = 30.0
    damping: float = 1.0
    integral_ratio: float = 10.0
    friction_adaptation: float = 10.0
    stick_speed: float = 0.01
    payload_ramp: float = 0.08
    velocity_time_constant: float = PAPER_TIME_CONSTANT


class ComputedTorque:
    """τ = M(q) (q̈_plan + K_p e + K_d ė + K_i ∫e) + C(q, q̇_plan) q̇_plan + g(q) + learnt friction, within the limits.

    Args:
        robot_empty: The arm with the hand as its payload.
        robot_loaded: The arm with hand and part; it takes over when the plan enters its third phase.
        dt: Control period (s).
        settings: Gains.
    """

    def __init__(
        self,
        robot_empty: RobotModel,
        robot_loaded: RobotModel,
        dt: float,
        settings: ComputedTorqueSettings | None = None,
    ) -> None:
        self.settings = settings or ComputedTorqueSettings()
        self._empty, self._loaded, self._dt = robot_empty, robot_loaded, dt
        self._limit = robot_empty.limits.torque
        n = robot_empty.n
        # The planned positions pass through the same filter as the measured ones: its lag then cancels in ė.
        self._measured = VelocityFilter(self.settings.velocity_time_constant, dt)
        self._planned = VelocityFilter(self.settings.velocity_time_constant, dt)
        self._integral = np.zeros(n)
        self._dry, self._viscous = np.zeros(n), np.zeros(n)
        self._loaded_since: float | None = None
        self.velocity = np.zeros(n)

    def command(self, observation: Observation, sample: PlanSample) -> Array:
        """Torques for this control period.

        Args:
            observation: Encoder positions now.
            sample: What the plan asks for now.

        Returns:
            (n,) torques within the motors' limits (Nm).
        """
        s, plan = self.settings, sample.arm
        q = observation.arm_position
        self.velocity = self._measured.update(q)
        error = plan.position - q
        error_rate = self._planned.update(plan.position) - self.velocity
        stiffness = s.bandwidth**2
        feedback = stiffness * error + 2 * s.damping * s.bandwidth * error_rate + self._integral
        direction = np.tanh(plan.velocity / s.stick_speed)
        friction = self._dry * direction + self._viscous * plan.velocity
        torque = self._inverse_dynamics(sample, q, plan.acceleration + feedback) + friction
        clipped = np.clip(torque, -self._limit, self._limit)
        # Anti-windup: a saturated joint does not integrate further into its limit.
        free = (torque == clipped) | (np.sign(error) != np.sign(torque))
        self._integral += np.where(free, s.integral_ratio * stiffness * error * self._dt, 0.0)
        if s.friction_adaptation > 0:
            self._learn_friction(q, plan.velocity, direction, free)
        return clipped

    def _inverse_dynamics(self, sample: PlanSample, q: Array, acceleration: Array) -> Array:
        velocity = sample.arm.velocity
        if sample.phase != "deliver":
            self._loaded_since = None
            return self._empty.inverse_dynamics(q, velocity, acceleration)
        if self._loaded_since is None:
            self._loaded_since = sample.arm.t
        share = min((sample.arm.t - self._loaded_since) / self.settings.payload_ramp, 1.0)
        torque = self._loaded.inverse_dynamics(q, velocity, acceleration)
        if share < 1.0:
            torque = share * torque + (1 - share) * self._empty.inverse_dynamics(q, velocity, acceleration)
        return torque

    def _learn_friction(self, q: Array, velocity: Array, direction: Array, free: Array) -> None:
        """Move what the integrator carries into friction terms, in proportion to how well they explain it.

        The integrator's torque is a constant times M(q); where it stands while a joint moves, friction is what it
        compensates. Splitting it by a normalised gradient step keeps the sum unchanged at that instant.
        """
        inertia = self._empty.mass_matrix(q)
        carried = inertia @ self._integral
        rate = self.settings.friction_adaptation * self._dt
        regressors = direction**2 + velocity**2
        step = np.where(free, rate * carried / (1.0 + regressors), 0.0)
        d_dry, d_viscous = step * direction, step * velocity
        self._dry += d_dry
        self._viscous += d_viscous
        moved = d_dry * direction + d_viscous * velocity
        self._integral -= np.linalg.solve(inertia, moved)
