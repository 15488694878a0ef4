"""The simulated world: the only place that knows MuJoCo."""

from dyngrasp.simulation import gl_backend

# MuJoCo reads its OpenGL back end once, when it is imported; no module of this package may come first.
gl_backend.choose()
