"""Where everything stands: the ground, the light and the sky of the MuJoCo world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

if TYPE_CHECKING:
    from mujoco import MjSpec


def set_stage(spec: MjSpec, ground: str, ground_friction: float) -> None:
    """Add ground, light and sky.

    Args:
        spec: The world.
        ground: Name of the plane z = 0.
        ground_friction: Its sliding friction.
    """
    spec.stat.center = [0.35, 0.0, 0.45]
    spec.stat.extent = 1.4
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = 1920, 1080
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 4
    visual.map.znear, visual.map.zfar = 0.02, 30.0
    visual.headlight.ambient, visual.headlight.diffuse = [0.32] * 3, [0.28] * 3
    visual.headlight.specular = [0.05] * 3
    visual.rgba.haze = [0.80, 0.84, 0.88, 1.0]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.95, 0.96, 0.97],
        rgb2=[0.72, 0.79, 0.86],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.56, 0.59, 0.62],
        rgb2=[0.525, 0.555, 0.585],
        markrgb=[0.47, 0.50, 0.53],
        width=512,
        height=512,
    )
    floor = spec.add_material(name="floor", texuniform=True, texrepeat=[2.5, 2.5], specular=0.1, shininess=0.1)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.worldbody.add_geom(
        name=ground,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.05],
        material="floor",
        friction=[ground_friction, 0.005, 0.0001],
    )
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        name="key", type=directional, pos=[1.2, -1.4, 2.6], dir=[-0.38, 0.52, -0.85], diffuse=[0.62] * 3,
        specular=[0.3] * 3, castshadow=True,
    )  # fmt: skip
    spec.worldbody.add_light(
        name="fill", type=directional, pos=[-1.0, 2.0, 2.0], dir=[0.45, -0.70, -0.55], diffuse=[0.22] * 3,
        specular=[0.05] * 3, castshadow=False,
    )  # fmt: skip
