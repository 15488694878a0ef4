"""Off-screen pictures of a scene. Encoding them as a video is the report's business."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dyngrasp.errors import RenderingUnavailable
from dyngrasp.simulation import gl_backend
from dyngrasp.simulation.scene import Scene

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """Where the camera stands.

    Attributes:
        lookat: Point in the middle of the picture, world frame (m).
        distance: From the camera to it (m).
        azimuth_deg: Heading of the line of sight about world z, 0 looking along +x.
        elevation_deg: Its elevation; negative looks down.
        fov_deg: Vertical field of view.
    """

    lookat: tuple[float, float, float] = (0.36, -0.06, 0.47)
    distance: float = 1.72
    azimuth_deg: float = 128.0
    elevation_deg: float = -16.0
    fov_deg: float = 38.0


OVERVIEW = View()
"""Arm, part and target in one picture."""

WIDE = View(lookat=(0.36, -0.14, 0.40), distance=2.05, elevation_deg=-19.0)
"""The same and the whole way of a part that rides on a conveyor."""


def close_up(point: ArrayLike) -> View:
    """A view of the fingers about a point (m)."""
    x, y, z = (float(v) for v in np.asarray(point, dtype=float))
    return View(lookat=(x, y, z), distance=0.62, azimuth_deg=150.0, elevation_deg=-14.0, fov_deg=38.0)


class Renderer:
    """Draws a scene into arrays; to be closed, or used in a `with` block.

    Args:
        scene: What to draw.
        width, height: Size of the pictures (pixels), at most 1920 × 1080.
        shadows: Draw shadows and smooth edges: about 100 ms a picture without a graphics card, against 6 ms.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen; names the Debian package that is missing.
    """

    def __init__(self, scene: Scene, *, width: int = 1280, height: int = 720, shadows: bool = True) -> None:
        gl_backend.require()
        self._scene = scene
        self._shadows = shadows
        model = scene.model
        if width > model.vis.global_.offwidth or height > model.vis.global_.offheight:
            raise ValueError(f"pictures up to {model.vis.global_.offwidth} × {model.vis.global_.offheight} pixels")
        samples = model.vis.quality.offsamples
        try:
            model.vis.quality.offsamples = samples if shadows else 0
            self._renderer = mujoco.Renderer(model, height=height, width=width)
        except Exception as error:  # the back ends raise what they like: AttributeError, FatalError, OpenGL errors
            raise RenderingUnavailable(
                f"no off-screen rendering: {error}; on Debian or Ubuntu install libegl1 and libgl1-mesa-dri"
            ) from error
        finally:
            model.vis.quality.offsamples = samples
        self._data = mujoco.MjData(model)
        self._camera = mujoco.MjvCamera()

    def frame(self, state: ArrayLike, view: View | None = None) -> Frame:
        """One picture.

        Args:
            state: (nq,) generalised positions as `MujocoPlant.state` gives and the record keeps them.
            view: Where the camera stands; if left out, where it sees everything that happens.

        Returns:
            (height, width, 3) uint8.
        """
        if view is None:
            view = OVERVIEW if self._scene.conveyor is None else WIDE
        model, data = self._scene.model, self._data
        data.qpos[:] = np.asarray(state, dtype=float)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.lookat[:] = view.lookat
        self._camera.distance = view.distance
        self._camera.azimuth, self._camera.elevation = view.azimuth_deg, view.elevation_deg
        model.vis.global_.fovy = view.fov_deg
        self._renderer.update_scene(data, self._camera)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        return self._renderer.render().copy()

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()

    def __enter__(self) -> Self:
        """Nothing to do: the context exists."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()
