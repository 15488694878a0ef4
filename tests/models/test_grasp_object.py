"""A part is read from its file, with what it stands on; and what such a file may not say."""

import shutil
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from dyngrasp.errors import ModelFileError
from dyngrasp.models.grasp_object import UNDERSIDE_CORNERS, read_object


@pytest.fixture
def folder(tmp_path) -> Path:
    """A small part of its own: a box that may be edited."""
    box = trimesh.creation.box((0.1, 0.034, 0.1))
    box.export(tmp_path / "box.stl")
    (tmp_path / "model.toml").write_text(
        """\
kind = "object"
name = "box"
mesh = "box.stl"
pieces = ["box.stl"]
mass = 0.5
centre_of_mass = [0.0, 0.0, 0.0]
rest_height = 0.05
[inertia]
ixx = 0.001
iyy = 0.001
izz = 0.001
ixy = 0.0
ixz = 0.0
iyz = 0.0
[[grasps]]
name = "one"
position = [0.0, 0.0, 0.04]
quat_wxyz = [1.0, 0.0, 0.0, 0.0]
width = 0.034
[[grasps]]
name = "two"
position = [0.0, 0.0, 0.04]
quat_wxyz = [0.0, 0.0, 0.0, 1.0]
width = 0.034
[funnel]
z_threshold = 0.1
sigma_x = 0.005
sigma_y = 0.002
[friction]
sliding = 0.7
torsional = 0.008
"""
    )
    return tmp_path


def test_the_small_part_is_read(folder):
    part = read_object(folder / "model.toml")
    assert part.name == "box"
    assert part.markers == ()
    assert [grasp.name for grasp in part.grasps] == ["one", "two"]
    np.testing.assert_allclose(part.grasps[1].T_object_grasp.rotation, pin.utils.rotate("z", np.pi), atol=1e-12)
    assert not part.inertia.flags.writeable


def test_underside_of_a_box_is_its_four_corners(folder):
    corners = read_object(folder / "model.toml").underside
    assert corners.shape == (UNDERSIDE_CORNERS, 3)
    assert {tuple(corner) for corner in corners.round(6)} == {
        (x, y, -0.05) for x in (-0.05, 0.05) for y in (-0.017, 0.017)
    }


@pytest.mark.parametrize(
    ("before", "after", "key", "value"),
    [
        ("mass = 0.5", "mass = 0.5\nmas = 1.0", "mas", "1.0"),
        ("[friction]", "[friction]\nrolling = 0.1", "friction.rolling", "0.1"),
        ('kind = "object"', 'kind = "robot"', "kind", "robot"),
        ("mass = 0.5\n", "", "mass", None),
        ('mesh = "box.stl"', 'mesh = "none.stl"', "mesh", "none.stl"),
        ('mesh = "box.stl"', 'mesh = "broken.stl"', "mesh", "broken.stl"),
        ('mesh = "box.stl"', 'mesh = "open.stl"', "mesh", "open.stl"),
        ('pieces = ["box.stl"]', 'pieces = ["box.stl", "none.stl"]', "pieces[1]", "none.stl"),
        ('pieces = ["box.stl"]', 'pieces = ["box.stl", "bent.stl"]', "pieces[1]", "bent.stl"),
        ('pieces = ["box.stl"]', 'pieces = ["open.stl"]', "pieces[0]", "open.stl"),
        ('pieces = ["box.stl"]', "pieces = []", "pieces", "[]"),
        ("mass = 0.5", "mass = 0.0", "mass", "0.0"),
        ("mass = 0.5", "mass = -0.5", "mass", "-0.5"),
        ("mass = 0.5", "mass = nan", "mass", "nan"),
        ("centre_of_mass = [0.0, 0.0, 0.0]", "centre_of_mass = [0.0, inf, 0.0]", "centre_of_mass[1]", "inf"),
        ("ixx = 0.001", "ixx = nan", "inertia.ixx", "nan"),
        ("ixx = 0.001", "ixx = 0.0021", "inertia", "0.0021"),
        ("ixy = 0.0", "ixy = 0.0011", "inertia", "-0.0001"),
        ("quat_wxyz = [0.0, 0.0, 0.0, 1.0]", "quat_wxyz = [0.0, 0.0, 0.5, 1.0]", "grasps[1].quat_wxyz", "0.5"),
        ("width = 0.034\n[funnel]", "width = 0.0\n[funnel]", "grasps[1].width", "0.0"),
        ('name = "two"', 'name = "one"', "grasps", "one"),
        ("sigma_y = 0.002", "sigma_y = 0.0", "funnel.sigma_y", "0.0"),
        ("sliding = 0.7", 'sliding = "much"', "friction.sliding", "much"),
    ],
)
def test_bad_files_are_refused_with_file_key_and_value(folder, before, after, key, value):
    box = trimesh.creation.box((0.1, 0.034, 0.1))
    trimesh.Trimesh(box.vertices, box.faces[:-1], process=False).export(folder / "open.stl")
    corner = trimesh.util.concatenate([box, trimesh.creation.box((0.02, 0.2, 0.02))])
    corner.export(folder / "bent.stl")
    (folder / "broken.stl").write_bytes(b"solid nothing\nendsolid nothing\n")
    path = folder / "model.toml"
    text = path.read_text()
    assert text.count(before) == 1
    path.write_text(text.replace(before, after))
    with pytest.raises(ModelFileError) as caught:
        read_object(path)
    message = str(caught.value)
    assert str(path) in message
    assert f"`{key}`" in message
    assert value is None or value in message


def test_a_part_without_grasps_is_refused(folder):
    path = folder / "model.toml"
    text = path.read_text()
    start, end = text.index("[[grasps]]"), text.index("[funnel]")
    path.write_text("grasps = []\n" + text[:start] + text[end:])
    with pytest.raises(ModelFileError, match=r"`grasps` = \[\].*at least one grasp"):
        read_object(path)


def test_a_file_that_is_missing_or_no_toml(folder):
    with pytest.raises(ModelFileError, match=r"none\.toml"):
        read_object(folder / "none.toml")
    shutil.copy(folder / "box.stl", folder / "model.toml")
    with pytest.raises(ModelFileError, match=r"model\.toml"):
        read_object(folder / "model.toml")
