"""Bound the Coriolis and centrifugal torques of an arm that carries a hand and a nominal part.

The figures go into `coriolis_bound_nm` of the arm's model.toml:

    python scripts/coriolis_bounds.py iiwa14
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import pinocchio as pin

from dyngrasp.errors import DyngraspError
from dyngrasp.models.catalogue import load_gripper, load_robot
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.limits import coriolis_bounds
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array


def nominal_part(gripper: GripperModel, mass: float, offset: float, size: float) -> pin.Inertia:
    """A solid ball in the pinch, its centre `offset` beyond the grasp point, in the flange frame."""
    centre = gripper.grasp_point(gripper.closed_posture) + offset * gripper.approach_axis
    return gripper.T_flange_hand.act(pin.Inertia.FromSphere(mass, size / 2).se3Action(pin.SE3(np.eye(3), centre)))


def bounds_with_hand(robot: RobotModel, loads: list[pin.Inertia], samples: int, seed: int) -> Array:
    """The larger of the bounds over everything that the arm carries in turn."""
    return np.max([coriolis_bounds(robot.with_payload(load), samples, seed) for load in loads], axis=0)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", help="name in the catalogue or path to a model.toml")
    parser.add_argument("--gripper", default="sdh2", help="name or path (default: %(default)s)")
    parser.add_argument("--part-mass", type=float, default=0.75, help="kg (default: %(default)s)")
    parser.add_argument(
        "--part-offset", type=float, default=0.035, help="m beyond the grasp point (default: %(default)s)"
    )
    parser.add_argument("--part-size", type=float, default=0.2, help="diameter, m (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=20_000, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        robot, gripper = load_robot(options.robot), load_gripper(options.gripper)
        empty = gripper.payload(gripper.open_posture)
        part = nominal_part(gripper, options.part_mass, options.part_offset, options.part_size)
        loaded = gripper.payload(gripper.closed_posture) + part
        bounds = bounds_with_hand(robot, [empty, loaded], options.samples, options.seed)
    except DyngraspError as error:
        print(error, file=sys.stderr)
        return 2
    print("coriolis_bound_nm = [" + ", ".join(f"{bound:g}" for bound in bounds) + "]")
    print("# share of the torque limits: " + ", ".join(f"{s:.1%}" for s in bounds / robot.limits.torque))
    print(f"# extremes reach {loaded.lever[2]:.3f} m beyond the flange with {loaded.mass:.2f} kg; seed {options.seed}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
