"""The offline planner: trapezoidal collocation with free phase durations."""
