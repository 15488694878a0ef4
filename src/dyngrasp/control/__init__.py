"""From a plan and sensor readings to joint torques."""
