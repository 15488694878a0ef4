"""Controllers of arm and gripper: joint state and plan in, torque out."""
