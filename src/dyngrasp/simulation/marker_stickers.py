"""The part's markers as thin printed stickers on its faces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import mujoco
import numpy as np

from dyngrasp.models.grasp_object import MARKER_DICTIONARIES

if TYPE_CHECKING:
    from mujoco import MjSpec
    from mujoco._specs import MjsBody

    from dyngrasp.models.grasp_object import GraspObject

# So far above the face that the depth buffer tells them apart (m), and so little that no pose shows it.
RISE = 1e-4

# Edge of one module of the pattern in the texture: corners stay sharp where the camera is near.
MODULE_PIXELS = 48

# Width of the white margin in modules: the detector finds the black border by it.
QUIET_MODULES = 0.75


def add_stickers(spec: MjSpec, body: MjsBody, part: GraspObject) -> None:
    """Stick all markers of a part on the body that stands for it.

    Args:
        spec: The world.
        body: Its body frame is the object frame.
        part: Carries the markers.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARIES[part.marker_dictionary]))
    modules = dictionary.markerSize + 2
    margin = round(QUIET_MODULES * MODULE_PIXELS)
    for marker in part.markers:
        inner = cv2.aruco.generateImageMarker(dictionary, marker.id, modules * MODULE_PIXELS)
        # Printer's black and paper's white are neither 0 nor 255.
        picture = np.pad(np.where(inner > 127, 235, 22).astype(np.uint8), margin, constant_values=235)
        name = f"marker_{marker.id}"
        texture = spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=picture.shape[1],
            height=picture.shape[0],
            nchannel=3,
        )
        texture.data = np.repeat(picture[..., None], 3, axis=2).tobytes()
        material = spec.add_material(name=name, specular=0.05, shininess=0.05)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        half = 0.5 * marker.size * picture.shape[0] / inner.shape[0]
        _add_slab(spec, name, half)
        T = marker.T_object_marker
        quat_wxyz = np.empty(4)
        mujoco.mju_mat2Quat(quat_wxyz, T.rotation.ravel())
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=name,
            pos=T.translation,
            quat=quat_wxyz,
            group=2,
            contype=0,
            conaffinity=0,
        )


def _add_slab(spec: MjSpec, name: str, half: float) -> None:
    """A slab with the picture on its upper face, upright along y. MuJoCo's meshes need a volume, however small."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    vertices = np.vstack([np.column_stack([square, np.full(4, z)]) for z in (RISE, 0.0)])
    faces = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]
    for k in range(4):
        n = (k + 1) % 4
        faces += [[k, k + 4, n + 4], [k, n + 4, n]]
    # The texture's first row is the picture's upper edge.
    texture = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]] * 2)
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel(),
        userface=np.ravel(faces),
        usertexcoord=texture.ravel(),
        smoothnormal=False,
    )
