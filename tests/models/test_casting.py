"""The casting: mass, shape, room for the fingers, stand."""

import importlib.util
from pathlib import Path

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dyngrasp.models.catalogue import load_object
from dyngrasp.models.grasp_object import UNDERSIDE_CORNERS

ROOT = Path(__file__).resolve().parents[2]
ALUMINIUM = 2700.0  # kg/m³, as the file says
STL = 1e-7  # m: coordinates of a tenth of a metre in single precision


@pytest.fixture(scope="module")
def casting():
    return load_object("casting")


@pytest.fixture(scope="module")
def mesh(casting) -> trimesh.Trimesh:
    return trimesh.load_mesh(casting.mesh_path)


@pytest.fixture(scope="module")
def pieces(casting) -> list[trimesh.Trimesh]:
    return [trimesh.load_mesh(path) for path in casting.piece_paths]


@pytest.fixture(scope="module")
def rib(casting, pieces) -> trimesh.Trimesh:
    """The one piece around the pinch."""
    (found,) = [piece for piece in pieces if room(piece, casting.grasps[0].T_object_grasp.translation[None])[0] > 0.01]
    return found


def room(convex: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(P,) distance to the nearest of the planes that bound a convex body, positive inside (m)."""
    normals = convex.face_normals
    return ((normals * convex.triangles[:, 0]).sum(axis=1) - points @ normals.T).min(axis=1)


def distances(shape, points: np.ndarray) -> np.ndarray:
    """(P,) exact distance of points from a shape of Coal (m)."""
    at, point = coal.Transform3s(), coal.Sphere(0.0)
    request = coal.DistanceRequest()
    return np.array(
        [
            coal.distance(shape, at, point, coal.Transform3s(np.eye(3), p), request, coal.DistanceResult())
            for p in points
        ]
    )


def surface(mesh: trimesh.Trimesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    return np.asarray(points), mesh.face_normals[faces]


def crossings(mesh: trimesh.Trimesh, points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(P,) how often a ray from each point meets the mesh (Möller and Trumbore)."""
    a, b, c = (mesh.triangles[:, i] for i in range(3))
    p = np.cross(direction, c - a)
    determinant = ((b - a) * p).sum(axis=1)
    flat = np.abs(determinant) < 1e-18
    inverse = 1.0 / np.where(flat, np.inf, determinant)
    counts = []
    for point in points:
        s = point - a
        u = (s * p).sum(axis=1) * inverse
        q = np.cross(s, b - a)
        v, t = (q @ direction) * inverse, ((c - a) * q).sum(axis=1) * inverse
        counts.append(int(((u > 0) & (v > 0) & (u + v < 1) & (t > 0) & ~flat).sum()))
    return np.array(counts)


# --- mass ------------------------------------------------------------------------------------------------------------


def test_mass_properties_are_those_of_the_mesh(casting, mesh):
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(mesh.split()) == 1, "one casting"
    mesh.density = ALUMINIUM
    # The file gives six and nine decimals of what was computed before rounding to single precision.
    assert casting.mass == pytest.approx(mesh.mass, rel=1e-5)
    np.testing.assert_allclose(casting.centre_of_mass, mesh.center_mass, atol=1e-6)
    np.testing.assert_allclose(casting.inertia, mesh.moment_inertia, atol=2e-8)


def test_moments_by_adding_up_tetrahedra(casting, mesh):
    """Another road to the same numbers: signed tetrahedra from the origin to every triangle."""
    a, b, c = (mesh.triangles[:, i] for i in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    centre = (volume[:, None] * (a + b + c) / 4).sum(axis=0) / volume.sum()
    a, b, c = a - centre, b - centre, c - centre
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    total = a + b + c
    spread = sum(np.einsum("i,ij,ik->jk", volume, x, x) for x in (a, b, c, total)) / 20
    inertia = ALUMINIUM * (np.trace(spread) * np.eye(3) - spread)
    np.testing.assert_allclose(casting.centre_of_mass, centre, atol=1e-6)
    np.testing.assert_allclose(casting.inertia, inertia, atol=2e-8)
    np.testing.assert_allclose(casting.spatial_inertia.inertia, inertia, atol=2e-8)
    assert casting.spatial_inertia.mass == casting.mass


def test_centre_of_mass_hangs_below_the_pinch(casting):
    for grasp in casting.grasps:
        along, _, height = grasp.T_object_grasp.actInv(np.array(casting.centre_of_mass))
        assert abs(along) < 0.006
        assert -0.050 < height < -0.020


# --- shape -----------------------------------------------------------------------------------------------------------


def test_pieces_are_convex_and_closed(pieces):
    for piece in pieces:
        assert piece.is_watertight
        assert room(piece, piece.vertices).min() > -2 * STL
        assert piece.volume > 0.1e-6


def test_pieces_cover_the_mesh_but_for_foundry_fillets(mesh, pieces):
    """A concave fillet of radius r, at most 5 mm here, stands r (1 − cos 45°) off the two faces that it joins."""
    points, _ = surface(mesh, 12000)
    outside = -np.max([room(piece, points) for piece in pieces], axis=0)
    rest = points[outside > 0.5e-3]
    assert len(rest) < 0.02 * len(points)
    shapes = []
    for piece in pieces:
        vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for vertex in piece.vertices:
            vertices.append(np.asarray(vertex))
        for face in piece.faces:
            faces.append(coal.Triangle(*(int(i) for i in face)))
        shapes.append(coal.Convex(vertices, faces))
    gap = np.min([distances(shape, rest) for shape in shapes], axis=0)
    # Facets of the arc and of the cylinder add a little.
    assert gap.max() < 5e-3 * (1 - np.cos(np.pi / 4)) + 1e-4
    # All of them lie at the foot of the rib, of the housing or of the screw bosses.
    assert ((rest[:, 2] < -0.059) & (rest[:, 2] > -0.0955)).all()


def test_pieces_stand_out_of_the_mesh_only_over_cores_and_bores(mesh, pieces):
    """Where a piece is farther than 0.5 mm outside the mesh, four of six directions at least meet a wall."""
    body = coal.BVHModelOBBRSS()
    body.beginModel(len(mesh.faces), len(mesh.vertices))
    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in mesh.vertices:
        vertices.append(np.asarray(vertex))
    for face in mesh.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    body.addSubModel(vertices, faces)
    body.endModel()
    out = []
    for piece in pieces:
        points, normals = surface(piece, 30)
        far = distances(body, points) > 0.5e-3
        # One millimetre below the surface, so that no ray runs along a face.
        out.append((points - 1e-3 * normals)[far])
    points = np.vstack(out)
    slant = np.array([0.013, 0.017, 0.011])  # no ray along an edge either
    rays = [sign * axis + slant for axis in np.eye(3) for sign in (1, -1)]
    met = np.array([crossings(mesh, points, ray) for ray in rays])
    inside = (met % 2 == 1).sum(axis=0) > 3
    enclosed = (met > 0).sum(axis=0) >= 4
    assert (inside | enclosed).all()
    assert (~inside).sum() > 30, "the casting is hollow"


def test_pinched_faces_are_flat_and_parallel(casting, mesh, rib):
    """34 mm apart over 32 mm along the rib, from 28 mm below the pinch to 10 mm above; in piece and mesh alike."""
    zone = np.array([[x, z] for x in (-0.016, 0.016) for z in (-0.028, 0.010)])
    for grasp in casting.grasps:
        assert grasp.width == 0.034
        T = grasp.T_object_grasp.inverse().homogeneous
        for body in (rib, mesh):
            for side in (1, -1):
                vertices = trimesh.transform_points(body.vertices, T)
                on_face = np.abs(vertices[:, 1] - side * grasp.width / 2) < STL
                outline = ConvexHull(vertices[on_face][:, [0, 2]]).equations
                assert (zone @ outline[:, :2].T + outline[:, 2] <= 0).all()
        points, normals = (
            trimesh.transform_points(x, M) for x, M in zip(surface(mesh, 40000), (T, rotation(T)), strict=True)
        )
        x, y, z = points.T
        beside = (np.abs(x) <= 0.016) & (z >= -0.028) & (z <= 0.010) & (np.abs(y) > 0.0125)
        assert beside.sum() > 500
        np.testing.assert_allclose(np.abs(y[beside]), 0.017, atol=STL)
        np.testing.assert_allclose(normals[beside][:, 1], np.sign(y[beside]), atol=1e-6)


def rotation(T: np.ndarray) -> np.ndarray:
    only = np.eye(4)
    only[:3, :3] = T[:3, :3]
    return only


def test_fingers_have_room(casting, mesh, pieces, rib):
    """Nothing but the rib stands where the fingers come down, and nothing at all where the palm does."""
    grasp_height = casting.grasps[0].T_object_grasp.translation[2]
    for body in (mesh, *(piece for piece in pieces if piece is not rib)):
        points = np.vstack([surface(body, 20000)[0], body.vertices])
        x, y, z = points.T
        # The fillet at the foot of the rib is half a millimetre wide where the pads may come down to.
        of_rib = (np.abs(y) <= 0.0175) & (np.abs(x) < 0.033)
        high = (np.abs(x) <= 0.050) & (np.abs(y) <= 0.110) & (z > grasp_height - 0.038)
        assert of_rib[high].all()
        assert of_rib[z > grasp_height - 0.010].all()


def test_it_stands(casting, mesh, pieces):
    """The centre of mass is well inside what it stands on, and the origin is at its rest height."""
    lowest = mesh.vertices[:, 2].min()
    assert lowest == pytest.approx(-casting.rest_height, abs=STL)
    assert min(piece.vertices[:, 2].min() for piece in pieces) == pytest.approx(lowest, abs=STL)
    foot = mesh.vertices[mesh.vertices[:, 2] < lowest + 1e-6][:, :2]
    edges = ConvexHull(foot).equations
    margin = -(edges[:, :2] @ casting.centre_of_mass[:2] + edges[:, 2]).max()
    # It may lean by more than 25° before it falls.
    assert margin > 0.03
    assert np.arctan2(margin, casting.centre_of_mass[2] - lowest) > np.deg2rad(25)


def test_underside_is_the_outline_of_what_it_stands_on(casting, pieces):
    corners = casting.underside
    assert corners.shape == (UNDERSIDE_CORNERS, 3)
    assert not corners.flags.writeable
    np.testing.assert_allclose(corners[:, 2], -casting.rest_height, atol=STL)
    vertices = np.vstack([piece.vertices for piece in pieces])
    foot = vertices[vertices[:, 2] < -casting.rest_height + 1e-5][:, :2]
    for corner in corners:
        assert np.abs(foot - corner[:2]).sum(axis=1).min() < STL
    # When it tips over towards any side, no more than this is missing of the edge that meets the ground first.
    for angle in np.deg2rad(np.arange(0, 360, 0.7)):
        direction = np.array([np.cos(angle), np.sin(angle)])
        assert -STL <= (foot @ direction).max() - (corners[:, :2] @ direction).max() < 0.006
    edges = ConvexHull(np.unique(corners[:, :2], axis=0)).equations
    assert (edges[:, :2] @ casting.centre_of_mass[:2] + edges[:, 2]).max() < -0.03


def test_grasps_are_the_same_pinch_from_both_sides(casting):
    one, other = (grasp.T_object_grasp for grasp in casting.grasps)
    np.testing.assert_allclose(one.actInv(other).homogeneous, np.diag([-1, -1, 1, 1]), atol=1e-12)
    np.testing.assert_allclose(one.rotation[:, 2], [0, 0, 1], atol=1e-12)


def test_markers_lie_on_flat_faces(casting, mesh):
    assert len({marker.id for marker in casting.markers}) == len(casting.markers) >= 3
    points, normals = surface(mesh, 60000)
    for marker in casting.markers:
        local = np.array([marker.T_object_marker.actInv(p) for p in points])
        outward = normals @ marker.T_object_marker.rotation[:, 2]
        before = (np.abs(local[:, :2]) < marker.size / 2).all(axis=1) & (np.abs(local[:, 2]) < 2e-3) & (outward > 0.5)
        assert before.sum() > 100
        np.testing.assert_allclose(local[before][:, 2], 0.0, atol=STL)


def test_script_reproduces_the_files(casting, tmp_path, monkeypatch):
    pytest.importorskip("manifold3d")
    spec = importlib.util.spec_from_file_location("make_casting", ROOT / "scripts" / "make_casting.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "make_casting", script)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "OUTPUT", tmp_path)
    script.main()
    folder = casting.mesh_path.parent
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in folder.iterdir())
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (folder / path.name).read_bytes(), path.name
