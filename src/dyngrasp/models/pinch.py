"""What two opposing pads can hold: one friction model for the planner's rows, the audit and the check of a grasp."""

from __future__ import annotations

from typing import Any, NamedTuple


class Pinch(NamedTuple):
    """Two pads that press a part between them. Entries may be numbers or CasADi symbols.

    Attributes:
        force: Normal force of each pad at rest, N (N).
        sliding: Coefficient μ of sliding friction.
        torsional: Coefficient t of torsional friction (m): moment about the normal over the normal force.
        width: Distance w of the two contacts (m).
    """

    force: Any
    sliding: Any
    torsional: Any
    width: Any


def pad_loads(force: Any, moment: Any, pinch: Pinch) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """How a wrench on the part is shared by the two pads, and what each can bear.

    In the grasp frame (x along the part, y across it from pad to pad, z outward) the pads at y = ±w/2 carry half of the
    tangential force each, plus the couple ±1/w of the moments about x and z. The moment about the line of the contacts
    is carried by torsional friction, half by each pad. A force along y loads one pad and relieves the other. Friction
    and torsion share a pad's capacity as an ellipse, a convex approximation of the limit surface of a patch.

    Args:
        force: (fx, fy, fz) that the hand exerts on the part (N): anything that can be indexed, numbers or symbols.
        moment: (mx, my, mz) about G (Nm).
        pinch: The grip.

    Returns:
        For the pad at y = w/2, then for the one at −w/2: the squared load over (μ N)², and the normal force over N. The
        pad holds while the first is at most the square of the second.
    """
    fx, fy, fz = force[0], force[1], force[2]
    mx, my, mz = moment[0], moment[1], moment[2]
    N, mu, t, w = pinch.force, pinch.sliding, pinch.torsional, pinch.width
    torsion, along_x, along_z = (my / (2 * t * N)) ** 2, mz / w, mx / w
    left = ((fx / 2 - along_x) ** 2 + (fz / 2 + along_z) ** 2) / (mu * N) ** 2 + torsion
    right = ((fx / 2 + along_x) ** 2 + (fz / 2 - along_z) ** 2) / (mu * N) ** 2 + torsion
    return (left, 1.0 - fy / (2 * N)), (right, 1.0 + fy / (2 * N))
