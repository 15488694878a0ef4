"""Flat things with a picture on them: the part's stickers, and a calibration board on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mujoco import MjSpec
    from mujoco._specs import MjsBody

# Printer's black and paper's white are neither 0 nor 255.
INK, PAPER = 22, 235


@dataclass(frozen=True, eq=False)
class PrintedSheet:
    """A rectangular slab that shows a picture.

    Its frame is in the middle of its lower face, x to the right and y upwards in the picture, z out of it.

    Attributes:
        name: Of its geom, texture and material; unique in a world.
        picture: (h, w) grey values; those above 127 are paper, the others ink.
        width: Of the picture (m); pixels are square.
        thickness: Height of the printed face above the frame's origin (m).
        T_body_sheet: Where it lies.
    """

    name: str
    picture: NDArray[np.uint8]
    width: float
    thickness: float
    T_body_sheet: pin.SE3

    @property
    def height(self) -> float:
        """Extent of the picture from top to bottom (m)."""
        return self.width * self.picture.shape[0] / self.picture.shape[1]


def add_sheet(spec: MjSpec, body: MjsBody, sheet: PrintedSheet) -> None:
    """Fix a sheet to a body; it weighs and touches nothing.

    Args:
        spec: The world.
        body: What the sheet lies on.
        sheet: What to add.
    """
    grey = np.where(sheet.picture > 127, PAPER, INK).astype(np.uint8)
    rows, columns = grey.shape
    texture = spec.add_texture(
        name=sheet.name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=columns, height=rows, nchannel=3
    )
    texture.data = np.repeat(grey[..., None], 3, axis=2).tobytes()
    material = spec.add_material(name=sheet.name, specular=0.05, shininess=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = sheet.name
    _add_slab(spec, sheet)
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, sheet.T_body_sheet.rotation.ravel())
    body.add_geom(
        name=sheet.name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=sheet.name,
        material=sheet.name,
        pos=sheet.T_body_sheet.translation,
        quat=quat_wxyz,
        group=2,
        contype=0,
        conaffinity=0,
    )


def _add_slab(spec: MjSpec, sheet: PrintedSheet) -> None:
    """A slab with the picture on its upper face, upright along y. MuJoCo's meshes need a volume, however small."""
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5 * np.array([sheet.width, sheet.height])
    vertices = np.vstack([np.column_stack([outline, np.full(4, z)]) for z in (sheet.thickness, 0.0)])
    faces = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]]
    for k in range(4):
        n = (k + 1) % 4
        faces += [[k, k + 4, n + 4], [k, n + 4, n]]
    # The texture's first row is the picture's upper edge.
    texture = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]] * 2)
    spec.add_mesh(
        name=sheet.name,
        uservert=vertices.ravel(),
        userface=np.ravel(faces),
        usertexcoord=texture.ravel(),
        smoothnormal=False,
    )
