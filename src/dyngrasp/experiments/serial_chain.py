"""Arms of any number of joints, to see how the planner's work grows with them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from dyngrasp.models.limits import JointLimits
from dyngrasp.models.robot import RobotModel

REACH = 1.3  # metres from the base to the tip, whatever the number of joints
MASS = 24.0  # kg of all links
TORQUE_RESERVE = 2.5  # torque limits as a multiple of what holds the stretched arm


def serial_chain(joints: int) -> RobotModel:
    """An upright arm whose axes alternate between roll and pitch, each link lighter than the one before.

    Args:
        joints: n ≥ 1.

    Returns:
        A model without a model file: kinematics "general", Coriolis bounds zero.
    """
    model = pin.Model()
    length = REACH / joints
    masses = np.linspace(1.6, 0.4, joints) * MASS / joints
    parent = 0
    for i in range(joints):
        joint = pin.JointModelRZ() if i % 2 == 0 else pin.JointModelRY()
        placement = pin.SE3(np.eye(3), np.array([0.0, 0.0, length if i else 0.0]))
        parent = model.addJoint(parent, joint, placement, f"joint_{i + 1}")
        link = pin.Inertia.FromCylinder(masses[i], 0.06, length)
        model.appendBodyToJoint(parent, link, pin.SE3(np.eye(3), np.array([0.01, 0.0, length / 2])))
    tip = pin.SE3(np.eye(3), np.array([0.0, 0.0, length]))
    model.addFrame(pin.Frame("tip", parent, 0, tip, pin.FrameType.OP_FRAME))
    model.armature = np.linspace(0.3, 0.05, joints)

    # Bent by a right angle at one pitch joint, the arm beyond it hangs on that joint with its longest lever.
    data, hold = model.createData(), np.full(joints, 10.0)
    for i in range(1, joints, 2):
        q = np.zeros(joints)
        q[i] = np.pi / 2
        hold = np.maximum(hold, np.abs(pin.computeGeneralizedGravity(model, data, q)))
    torque = TORQUE_RESERVE * np.maximum.accumulate(hold[::-1])[::-1]
    limits = JointLimits(
        position_lower=np.full(joints, -np.deg2rad(170)),
        position_upper=np.full(joints, np.deg2rad(170)),
        velocity=np.deg2rad(np.linspace(85, 135, joints)),
        torque=torque,
    )
    return RobotModel(
        name=f"chain{joints}",
        description=f"generated arm of {joints} joints",
        limits=limits,
        pin_model=model,
        tip_frame="tip",
        kinematics="general",
        srs=None,
        mjcf_path=None,
        urdf_path=None,
    )
