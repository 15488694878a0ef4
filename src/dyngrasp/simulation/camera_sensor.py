"""What the camera on the hand sees of the running simulation: lens, exposure time, noise and vignetting included.

MuJoCo draws an ideal pinhole that sees a little more than the camera; its picture is bent to what the lens would show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from dyngrasp.errors import InvalidProblem, RenderingUnavailable
from dyngrasp.models.camera import CameraModel, picture_border
from dyngrasp.simulation import gl_backend
from dyngrasp.simulation.scene import Scene

Picture = NDArray[np.uint8]

# Of what is drawn (m): the fingers are nearer than the general view's clipping plane.
NEAR, FAR = 0.005, 10.0


@dataclass(frozen=True)
class ImagingSettings:
    """How pictures differ from ideal ones.

    Attributes:
        brightness: Factor on all grey values before they saturate.
        noise: Standard deviation of the sensor's noise in the dark (grey values of 255).
        shot_noise: The same at white, of what the light itself adds; grows with the root of the brightness.
        vignetting: Share of the light that is missing in the corners; falls with the fourth power of the distance from
            the middle.
        samples: Of each pixel along its edges, 0 or a power of two up to 8.
        shadows: Draw shadows; slow without a graphics card.
        seed: Of the noise.
    """

    brightness: float = 1.0
    noise: float = 1.5
    shot_noise: float = 2.0
    vignetting: float = 0.2
    samples: int = 4
    shadows: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.brightness) and self.brightness > 0):
            raise InvalidProblem(f"brightness must be > 0, got {self.brightness}")
        if not (np.isfinite([self.noise, self.shot_noise]).all() and min(self.noise, self.shot_noise) >= 0):
            raise InvalidProblem(f"noise must be ≥ 0, got {self.noise} and {self.shot_noise}")
        if not 0.0 <= self.vignetting < 1.0:
            raise InvalidProblem(f"vignetting must be in [0, 1), got {self.vignetting}")
        if self.samples not in (0, 2, 4, 8):
            raise InvalidProblem(f"samples must be one of 0, 2, 4, 8, got {self.samples}")


@dataclass(frozen=True, eq=False)
class CameraImage:
    """One picture.

    Attributes:
        pixels: (height, width) grey values, read-only.
        t_open, t_close: First and last moment of the exposure (s).
    """

    pixels: Picture
    t_open: float
    t_close: float

    def __post_init__(self) -> None:
        self.pixels.setflags(write=False)

    @property
    def t_capture(self) -> float:
        """Middle of the exposure (s): where a marker in uniform motion is found."""
        return 0.5 * (self.t_open + self.t_close)


class CameraSensor:
    """A camera in a scene; to be closed, or used in a `with` block.

    Args:
        scene: What to look at; built with `markers=True` if markers shall be seen.
        camera: The true camera: what perception believes of it may differ.
        settings: Light and noise.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen; names the Debian package that is missing.
    """

    def __init__(self, scene: Scene, camera: CameraModel, settings: ImagingSettings | None = None) -> None:
        gl_backend.require()
        self.camera, self.settings = camera, settings or ImagingSettings()
        self._scene = scene
        self._rng = np.random.default_rng(self.settings.seed)
        self._data = mujoco.MjData(scene.model)
        rays = camera.undistort(picture_border(camera))
        # Whole pixels of the ideal picture with one to spare for the interpolation, edges as in `project`.
        low = np.floor(rays.min(axis=0) * camera.focal + camera.centre) - 2.0
        high = np.ceil(rays.max(axis=0) * camera.focal + camera.centre) + 2.0
        width, height = (int(n) for n in high - low + 1)
        self._corner = low
        self._frustum = (np.array([low - 0.5, high + 0.5]) - camera.centre) / camera.focal
        self._map = self._lens_map(low)
        self._fall_off = self._vignette()
        self._renderer = self._open(width, height)

    def capture(self, states: Sequence[ArrayLike], times: Sequence[float]) -> CameraImage:
        """One picture from the states that the simulation passed through while the shutter was open.

        Args:
            states: (nq,) generalised positions, as `MujocoPlant.state` gives them: one for a picture without motion
                blur, several to be averaged.
            times: Of each (s), ascending.

        Raises:
            InvalidProblem: No state, or not one time for each, or times that do not ascend.
        """
        if len(states) == 0 or len(states) != len(times) or (np.diff(times) <= 0).any():
            raise InvalidProblem(f"one ascending time for each state expected, got {len(states)} and {list(times)}")
        light = np.zeros((self.camera.height, self.camera.width), np.float32)
        for state in states:
            light += self._expose(np.asarray(state, dtype=float))
        light *= self._fall_off * (self.settings.brightness / len(states))
        s = self.settings
        if s.noise > 0 or s.shot_noise > 0:
            sigma = np.sqrt(s.noise**2 + s.shot_noise**2 * np.clip(light, 0, 255) / 255.0)
            light += sigma.astype(np.float32) * self._rng.standard_normal(light.shape, dtype=np.float32)
        pixels = np.clip(np.round(light), 0, 255).astype(np.uint8)
        return CameraImage(pixels, float(times[0]), float(times[-1]))

    def pose(self, state: ArrayLike) -> pin.SE3:
        """T_world_camera in a state: the truth."""
        model, data, hand = self._scene.model, self._data, self._scene.hand_body
        data.qpos[:] = np.asarray(state, dtype=float)
        mujoco.mj_kinematics(model, data)
        T_world_hand = pin.SE3(data.xmat[hand].reshape(3, 3).copy(), data.xpos[hand].copy())
        return T_world_hand * self.camera.T_hand_camera

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()

    def __enter__(self) -> Self:
        """Nothing to do: the context exists."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _open(self, width: int, height: int) -> mujoco.Renderer:
        model = self._scene.model
        visual = model.vis
        before = visual.quality.offsamples, visual.global_.offwidth, visual.global_.offheight
        try:
            visual.quality.offsamples = self.settings.samples
            visual.global_.offwidth, visual.global_.offheight = width, height
            return mujoco.Renderer(model, height=height, width=width)
        except Exception as error:  # the back ends raise what they like: AttributeError, FatalError, OpenGL errors
            raise RenderingUnavailable(
                f"no off-screen rendering: {error}; on Debian or Ubuntu install libegl1 and libgl1-mesa-dri"
            ) from error
        finally:
            visual.quality.offsamples, visual.global_.offwidth, visual.global_.offheight = before

    def _expose(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """Grey values without noise of one moment."""
        T = self.pose(state)
        mujoco.mj_comPos(self._scene.model, self._data)
        mujoco.mj_camlight(self._scene.model, self._data)
        self._renderer.update_scene(self._data)
        scene = self._renderer.scene
        (left, top), (right, bottom) = self._frustum
        for eye in scene.camera:
            eye.pos, eye.forward, eye.up = T.translation, T.rotation[:, 2], -T.rotation[:, 1]
            eye.orthographic = 0
            eye.frustum_near, eye.frustum_far = NEAR, FAR
            eye.frustum_center, eye.frustum_width = 0.5 * (left + right) * NEAR, 0.5 * (right - left) * NEAR
            # The picture's y axis points down, OpenGL's up.
            eye.frustum_bottom, eye.frustum_top = -bottom * NEAR, -top * NEAR
        for light in scene.lights[: scene.nlight]:
            if light.headlight:
                # For people's pictures. The camera carries no lamp: only the even part, the room's light, stays.
                light.diffuse, light.specular = np.zeros(3), np.zeros(3)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self.settings.shadows
        grey = cv2.cvtColor(self._renderer.render(), cv2.COLOR_RGB2GRAY).astype(np.float32)
        return cv2.remap(grey, self._map[0], self._map[1], cv2.INTER_LINEAR).astype(np.float32, copy=False)

    def _lens_map(self, low: NDArray[np.float64]) -> NDArray[np.float32]:
        """(2, height, width): column and row in the ideal picture of what each pixel sees."""
        camera = self.camera
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.undistort(np.column_stack([u.ravel(), v.ravel()]))
        ideal = rays * camera.focal + camera.centre - low
        return np.ascontiguousarray(ideal.T.astype(np.float32)).reshape(2, camera.height, camera.width)

    def _vignette(self) -> NDArray[np.float32]:
        camera = self.camera
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        corner = np.hypot(camera.width, camera.height) / 2
        radius = np.hypot(u - (camera.width - 1) / 2, v - (camera.height - 1) / 2) / corner
        return (1.0 - self.settings.vignetting * radius**4).astype(np.float32)
