"""Dynamic grasping with online trajectory replanning."""
