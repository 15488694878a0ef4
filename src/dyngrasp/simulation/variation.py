"""How a simulated plant deviates from the model that plans and controls it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Array, read_only

# Neither friction nor rotor inertia of the real arm is public. Assumed from the first to the last joint of an arm.
DAMPING_RANGE = (2.0, 0.5)  # Nm s/rad
DRY_FRICTION_RANGE = (1.0, 0.3)  # Nm


@dataclass(frozen=True)
class PlantVariation:
    """What the planner and the controllers do not know about the plant.

    Attributes:
        mass_factor: Mass and inertia of the part over their nominal values, > 0.
        friction: Coefficient of sliding friction between pad and part, ≥ 0.
        torsional_friction: Torque about the contact normal over the normal force (m), ≥ 0.
        armature_factors: (n,) reflected rotor inertias of the arm over their nominal values, > 0.
        damping: (n,) viscous friction of the arm joints (Nm s/rad), ≥ 0.
        dry_friction: (n,) dry friction of the arm joints (Nm), ≥ 0.

    Raises:
        InvalidProblem: A value out of its range, or arrays of different lengths.
    """

    mass_factor: float
    friction: float
    torsional_friction: float
    armature_factors: Array
    damping: Array
    dry_friction: Array

    def __post_init__(self) -> None:
        for name in ("armature_factors", "damping", "dry_friction"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1,)))
        if not self.armature_factors.size == self.damping.size == self.dry_friction.size:
            raise InvalidProblem("plant variation: armature_factors, damping and dry_friction need one entry a joint")
        for name, low in (("mass_factor", 0.0), ("armature_factors", 0.0)):
            if not (np.isfinite(getattr(self, name)).all() and (np.asarray(getattr(self, name)) > low).all()):
                raise InvalidProblem(f"plant variation: {name} = {getattr(self, name)} must be > {low:g}")
        for name in ("friction", "torsional_friction", "damping", "dry_friction"):
            values = np.asarray(getattr(self, name))
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise InvalidProblem(f"plant variation: {name} = {getattr(self, name)} must be ≥ 0")

    @classmethod
    def ideal(cls, joints: int, *, friction: float, torsional_friction: float) -> PlantVariation:
        """The arm exactly as its model has it, without joint friction: for tests of the controllers."""
        return cls(1.0, friction, torsional_friction, np.ones(joints), np.zeros(joints), np.zeros(joints))

    @classmethod
    def nominal(cls, joints: int, *, friction: float, torsional_friction: float) -> PlantVariation:
        """The part as its file says and rotor inertias as modelled; joint friction at its assumed values."""
        return cls(
            1.0,
            friction,
            torsional_friction,
            np.ones(joints),
            np.linspace(*DAMPING_RANGE, joints),
            np.linspace(*DRY_FRICTION_RANGE, joints),
        )

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        joints: int,
        *,
        friction_range: tuple[float, float] = (0.6, 0.9),
        torsional_over_sliding: float = 0.0125,
        mass_spread: float = 0.1,
        armature_spread: float = 0.2,
        joint_friction_spread: float = 0.2,
    ) -> PlantVariation:
        """One plant out of the family that the studies assume; all quantities are uniform in their ranges.

        Args:
            rng: Source of randomness; the same state gives the same plant.
            joints: n of the arm.
            friction_range: Range of the sliding friction of rubber on cast metal.
            torsional_over_sliding: Torsional over sliding friction (m): two thirds of the radius of the contact patch,
                so that both move together.
            mass_spread: The mass factor is 1 ± this.
            armature_spread: The armature factors are 1 ± this, each joint on its own.
            joint_friction_spread: Damping and dry friction are their assumed values times 1 ± this.
        """
        friction = float(rng.uniform(*friction_range))
        mass = float(rng.uniform(1 - mass_spread, 1 + mass_spread))
        armature = rng.uniform(1 - armature_spread, 1 + armature_spread, joints)
        damping, dry = rng.uniform(1 - joint_friction_spread, 1 + joint_friction_spread, (2, joints))
        return cls(
            mass,
            friction,
            friction * torsional_over_sliding,
            armature,
            np.linspace(*DAMPING_RANGE, joints) * damping,
            np.linspace(*DRY_FRICTION_RANGE, joints) * dry,
        )
