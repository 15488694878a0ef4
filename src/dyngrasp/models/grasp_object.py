"""The part: what it weighs, where it may be pinched, how it is approached, and what marks it carries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import pinocchio as pin
import trimesh

from dyngrasp.errors import ModelFileError
from dyngrasp.models.model_file import Finite, PoseTable, Positive, StrictSchema, Vector3, decode, read_toml
from dyngrasp.signals import Array, read_only

# Families of markers by the names of the model file, and what OpenCV calls them.
MARKER_DICTIONARIES = MappingProxyType(
    {
        "4x4_50": "DICT_4X4_50",
        "5x5_50": "DICT_5X5_50",
        "6x6_50": "DICT_6X6_50",
        "apriltag_36h11": "DICT_APRILTAG_36h11",
    }
)

# A piece counts as convex if it fills its hull to this share: vertices are stored in single precision.
CONVEX_SHARE = 1e-4

# Corners that stand for the outline of the underside; the casting's edge is 6 mm farther out between them at most.
UNDERSIDE_CORNERS = 8


class GraspTable(PoseTable):
    """One `[[grasps]]` entry."""

    name: str
    width: Positive


class FunnelTable(StrictSchema):
    """`[funnel]`."""

    z_threshold: Positive
    sigma_x: Positive
    sigma_y: Positive


class FrictionTable(StrictSchema):
    """`[friction]`."""

    sliding: Positive
    torsional: Positive


class MarkerTable(PoseTable):
    """One `[[markers]]` entry."""

    id: int
    size: Positive


MarkerDictionary = Literal["4x4_50", "5x5_50", "6x6_50", "apriltag_36h11"]


class InertiaTable(StrictSchema):
    """`[inertia]` about the centre of mass in object axes (kg m²)."""

    ixx: Positive
    iyy: Positive
    izz: Positive
    ixy: Finite
    ixz: Finite
    iyz: Finite


class ObjectFile(StrictSchema):
    """A part's model.toml."""

    kind: Literal["object"]
    name: str
    description: str = ""
    mesh: str
    pieces: tuple[str, ...]
    mass: Positive
    centre_of_mass: Vector3
    inertia: InertiaTable
    rest_height: Finite
    grasps: tuple[GraspTable, ...]
    funnel: FunnelTable
    friction: FrictionTable
    marker_dictionary: MarkerDictionary = "4x4_50"
    markers: tuple[MarkerTable, ...] = ()


@dataclass(frozen=True, eq=False)
class Grasp:
    """A pinch: origin at its centre, z outward along the approach axis, y along the closing axis.

    Attributes:
        name: As in the model file.
        T_object_grasp: The grasp frame in the object frame.
        width: Distance of the two pinched faces along y (m).
    """

    name: str
    T_object_grasp: pin.SE3
    width: float


@dataclass(frozen=True)
class Funnel:
    """The inverted Gaussian of eq. (5) in the grasp frame: threshold height and standard deviations (m)."""

    z_threshold: float
    sigma_x: float
    sigma_y: float


@dataclass(frozen=True)
class Friction:
    """Pad on part: sliding coefficient, and torsional coefficient (m), moment over normal force."""

    sliding: float
    torsional: float


@dataclass(frozen=True, eq=False)
class Marker:
    """A square fiducial: its number, edge length (m) and pose in the object frame, z out of the face."""

    id: int
    size: float
    T_object_marker: pin.SE3


@dataclass(frozen=True, eq=False)
class GraspObject:
    """A part that can be pinched.

    Attributes:
        name, description: As in the model file.
        mass: kg.
        centre_of_mass: (3,) in the object frame (m).
        inertia: (3, 3) about the centre of mass in object axes (kg m²).
        mesh_path: Closed surface mesh (m, object frame).
        piece_paths: Convex pieces that stand for it in contact.
        rest_height: World z of the object origin when the part stands on the ground (m).
        grasps: The pinches it offers.
        funnel: Where the grasp point may pass on the approach.
        friction: Pad on part, as the planner assumes it.
        markers: Fiducials on its faces.
        marker_dictionary: Which family of patterns they belong to.
    """

    name: str
    description: str
    mass: float
    centre_of_mass: Array
    inertia: Array
    mesh_path: Path
    piece_paths: tuple[Path, ...]
    rest_height: float
    grasps: tuple[Grasp, ...]
    funnel: Funnel
    friction: Friction
    markers: tuple[Marker, ...]
    marker_dictionary: MarkerDictionary = "4x4_50"

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_of_mass", read_only(self.centre_of_mass, (3,)))
        object.__setattr__(self, "inertia", read_only(self.inertia, (3, 3)))

    @cached_property
    def spatial_inertia(self) -> pin.Inertia:
        """Mass, centre of mass and inertia in the object frame; not to be changed."""
        return pin.Inertia(self.mass, np.array(self.centre_of_mass), np.array(self.inertia))

    @cached_property
    def underside(self) -> Array:
        """(UNDERSIDE_CORNERS, 3) corners of the face it stands on, in the object frame (m).

        Each is the outermost of its lowest points in the direction in which the ones before it leave most of the
        outline out; some may coincide.
        """
        vertices = np.vstack([trimesh.load_mesh(path).vertices for path in self.piece_paths])
        lowest = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-4]
        angles = np.deg2rad(np.arange(360))
        reach = np.column_stack([np.cos(angles), np.sin(angles)]) @ lowest[:, :2].T
        corners = [int(reach[0].argmax())]
        while len(corners) < UNDERSIDE_CORNERS:
            left_out = reach.max(axis=1) - reach[:, corners].max(axis=1)
            corners.append(int(reach[left_out.argmax()].argmax()))
        return read_only(lowest[corners])


def read_object(path: str | Path) -> GraspObject:
    """Read a part from its model.toml.

    Args:
        path: The TOML file; the meshes that it names lie relative to it.

    Raises:
        ModelFileError: A key is unknown, missing or out of range, the inertia is no rigid body's, the mesh is missing
            or not closed, or a piece is not convex.
    """
    path = Path(path)
    table = decode(ObjectFile, read_toml(path), path)
    if not table.grasps:
        raise ModelFileError(path, "grasps", [], "at least one grasp")
    names = [grasp.name for grasp in table.grasps]
    if len(set(names)) != len(names):
        raise ModelFileError(path, "grasps", names, "names that differ from one another")
    ids = [marker.id for marker in table.markers]
    if len(set(ids)) != len(ids):
        raise ModelFileError(path, "markers", ids, "ids that differ from one another")
    inertia = _inertia(table.inertia, path)
    mesh = _load_mesh(path, "mesh", table.mesh)
    if not mesh.is_watertight:
        raise ModelFileError(path, "mesh", table.mesh, "a closed mesh; this one has holes or unmatched edges")
    if not table.pieces:
        raise ModelFileError(path, "pieces", [], "at least one convex piece")
    for i, name in enumerate(table.pieces):
        piece = _load_mesh(path, f"pieces[{i}]", name)
        if not piece.is_watertight or piece.volume < (1.0 - CONVEX_SHARE) * piece.convex_hull.volume:
            raise ModelFileError(path, f"pieces[{i}]", name, "a closed convex mesh")
    return GraspObject(
        name=table.name,
        description=table.description,
        mass=table.mass,
        centre_of_mass=np.array(table.centre_of_mass),
        inertia=inertia,
        mesh_path=path.parent / table.mesh,
        piece_paths=tuple(path.parent / name for name in table.pieces),
        rest_height=table.rest_height,
        grasps=tuple(Grasp(g.name, g.pose, g.width) for g in table.grasps),
        funnel=Funnel(table.funnel.z_threshold, table.funnel.sigma_x, table.funnel.sigma_y),
        friction=Friction(table.friction.sliding, table.friction.torsional),
        markers=tuple(Marker(m.id, m.size, m.pose) for m in table.markers),
        marker_dictionary=table.marker_dictionary,
    )


def _inertia(table: InertiaTable, path: Path) -> Array:
    xy, xz, yz = table.ixy, table.ixz, table.iyz
    inertia = np.array([[table.ixx, xy, xz], [xy, table.iyy, yz], [xz, yz, table.izz]])
    low, middle, high = np.linalg.eigvalsh(inertia)
    if low <= 0 or low + middle < high:
        raise ModelFileError(
            path,
            "inertia",
            [float(f"{moment:.3g}") for moment in (low, middle, high)],
            "principal moments that are positive and of which no two add up to less than the third",
        )
    return inertia


def _load_mesh(path: Path, key: str, name: str) -> trimesh.Trimesh:
    file = path.parent / name
    if not file.is_file():
        raise ModelFileError(path, key, name, f"a file that exists; there is no {file}")
    try:
        mesh = trimesh.load_mesh(file)
    except Exception as error:  # trimesh raises whatever its format's reader does
        raise ModelFileError(path, key, name, f"a mesh that can be read ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ModelFileError(path, key, name, "a mesh with at least one triangle")
    return mesh
