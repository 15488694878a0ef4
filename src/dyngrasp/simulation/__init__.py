"""The simulated world: the only place that knows MuJoCo."""
