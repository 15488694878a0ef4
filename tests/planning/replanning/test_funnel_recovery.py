"""The factor of the funnel's wall against its definition, by forward kinematics of the arm's description."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.planning.replanning.funnel_recovery import funnel_recovery
from dyngrasp.trajectory import Trajectory

SHARES, REACTION = (0.4, 0.8), 0.1


def defined(plan, t, targets, task):
    """The largest φ that leaves G a millimetre inside now and a reaction later, but never past the pre-grasp."""
    funnel, gripper, factors = task.grasp_object.funnel, task.gripper, [1.0]
    for when in (t, min(t + REACTION, plan.phase_ends[0] - 1e-12)):
        state = plan.sample(when)
        hand = task.robot.forward_kinematics(state.arm.position) * gripper.T_flange_hand
        G = hand * gripper.T_hand_grasp(state.gripper.position)
        grasp_frame = targets.T_world_object_at(when) * targets.grasp.T_object_grasp
        x, y, z = grasp_frame.actInv(G).translation
        wall = funnel.z_threshold * (1.0 - np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2)))
        if z - wall < 0.001:
            factors.append(min(0.98 * z, z - 0.0012) / wall if z > 0.0012 else 0.0)
    return min(factors)


def opening(plan):
    """The same plan with fingers that move all through the approach."""
    approach, hand = plan.arm[0], plan.gripper[0]
    T, left = approach.duration, np.linspace(1.0, 0.0, approach.intervals + 1)[:, None]
    path, rate, curvature = 0.2 * left**2, -0.4 * left / T, np.full(left.shape, 0.4 / T**2)
    still = np.zeros(hand.position.shape)
    moving = Trajectory(T, hand.position + path, still + rate, still + curvature)
    return replace(plan, gripper=(moving, *plan.gripper[1:]))


@pytest.mark.parametrize("fingers_move", [False, True])
@pytest.mark.parametrize("speed", [0.0, 0.04])
def test_wall_is_lowered_as_far_as_the_hand_needs_and_no_farther(plan, targets, task, speed, fingers_move):
    random, seen = np.random.default_rng(3), []
    running = opening(plan) if fingers_move else plan
    for _ in range(300):
        t = plan.phase_ends[0] - random.uniform(0.02, 1.0)
        offset = random.normal(size=3) * [0.01, 0.01, 0.02]
        T = targets.T_world_object
        T = pin.SE3(pin.exp3(random.normal(size=3) * [0.02, 0.02, 0.2]) @ T.rotation, T.translation + offset)
        twist = speed * random.normal(size=6)
        new = replace(targets, T_world_object=T, twist_world=twist, grasp_time=float(plan.phase_ends[1]))
        found, wanted = funnel_recovery(running, t, new, task, SHARES, REACTION), defined(running, t, new, task)
        # Rounding of the poses, over the least wall that is softened, 0.2 mm.
        assert (found.factor if found else 0.0) == pytest.approx(wanted, abs=1e-9)
        seen.append(wanted)
    # All three answers: nothing to be done, a factor, no help.
    assert min(seen.count(0.0), seen.count(1.0), sum(0.0 < factor < 1.0 for factor in seen)) >= 10
