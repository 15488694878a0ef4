"""Where the hand has to be and how it has to move when it grasps, and what an S-R-S arm does for that; compiled.

Of two things the first is for the pre-grasp, where the open hand moves in above the part, the second for the grasp,
where the closed hand lifts it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.models.flange_chain import least_rates
from dyngrasp.models.inverse_kinematics import TWIST_TOLERANCE, write_null_space_velocity
from dyngrasp.models.srs_chain import write_null_space_rate
from dyngrasp.models.srs_search import follow_configuration
from dyngrasp.motion_arrays import largest_difference
from dyngrasp.planning.part_motion import part_poses


@njit(cache=True, error_model="numpy")
def flange_goals(aim):
    """Poses [R | p] (2, 3, 4) and twists (2, 6) of the flange; twists in world axes, like that of the part.

    Args:
        aim: Pose (4, 4) of the part at the grasp; its velocity (m/s) and angular velocity (rad/s), (6,); how long
            before the grasp the hand is at the pre-grasp (s); poses (2, 3, 4) of the flange in the object frame and the
            axis (3,) of the open hand that points away from the part, in the flange frame; speed of the approach
            along that axis and of the lift along world z (m/s).
    """
    T_world_object, twist, duration, (at_part, outward), (approach, lift) = aim
    R, p = np.empty((3, 3, 2)), np.empty((3, 2))
    part_poses((T_world_object[:3, :3], T_world_object[:3, 3], twist, duration), np.array([0.0, duration]), R, p)
    poses, twists, lever = np.empty((2, 3, 4)), np.empty((2, 6)), np.empty(3)
    for k in range(2):
        for a in range(3):
            for b in range(4):
                poses[k, a, b] = 0.0
                for c in range(3):
                    poses[k, a, b] += R[a, c, k] * at_part[k, c, b]
            lever[a] = poses[k, a, 3]
            poses[k, a, 3] += p[a, k]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            twists[k, a] = twist[a] + twist[3 + b] * lever[c] - twist[3 + c] * lever[b]
            twists[k, 3 + a] = twist[3 + a]
    for a in range(3):
        for b in range(3):
            twists[0, a] -= approach * poses[0, a, b] * outward[b]
    twists[1, 2] += lift
    return poses, twists


@njit(cache=True, error_model="numpy")
def srs_boundary_states(aim, previous, largest_turn, arm, chain, swivel, states):
    """Write positions (rad) and velocities (rad/s) of an S-R-S arm that has its flange where `flange_goals` says.

    Args:
        aim: Of `flange_goals`.
        previous: Positions and velocities that these shall be like, both for the pre-grasp and then both for the grasp,
            each (7,): branch and arm angle are kept, and the way in which the elbow swings.
        largest_turn: Most that a joint may turn from the previous position (rad).
        arm: `SrsKinematics.arrays`.
        chain: `FlangeChain.rotations` and `.offsets`.
        swivel: Of the velocity in the null space: the last three arguments of `null_space_velocity`.
        states: (2, 2, 7) in which they are written, each position before its velocity.

    Returns:
        Whether all are found. Reach and limits may forbid a position, and a singular one has no such velocity.
    """
    poses, twists = flange_goals(aim)
    (rotations, offsets), (limit, least_rate, least_ratio), rate = chain, swivel, np.empty(7)
    for k in range(2):
        q, w, like = states[k, 0], states[k, 1], previous[2 * k]
        if not (follow_configuration(poses[k], like, arm, q) and largest_difference(q, like) <= largest_turn):
            return False
        if not (0.0 <= least_rates(rotations, offsets, q, twists[k], w) <= TWIST_TOLERANCE):
            return False
        if not write_null_space_rate(q, arm[0], rate):
            return False
        write_null_space_velocity(rate, previous[2 * k + 1], limit, least_rate, least_ratio, rate)
        for i in range(7):
            w[i] += rate[i]
    return True
