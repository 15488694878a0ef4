"""Pictures, and what happens on a machine that cannot draw."""

import os
import subprocess
import sys

import numpy as np
import pytest

from dyngrasp.errors import RenderingUnavailable
from dyngrasp.simulation import gl_backend
from dyngrasp.simulation.rendering import Renderer, close_up


@pytest.fixture(scope="module")
def renderer(scene):
    try:
        gl_backend.require()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    with Renderer(scene, width=320, height=180, shadows=False) as renderer:
        yield renderer


def test_a_picture_shows_the_scene(renderer, scene, make_plant):
    plant = make_plant(scene, position=(0.65, 0.0, None))
    picture = renderer.frame(plant.state)
    assert picture.shape == (180, 320, 3)
    assert picture.dtype == np.uint8
    # The rings of the arm are orange, nothing else is.
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    assert ((red > 150) & (green < 140) & (blue < 90)).sum() > 20


def test_a_moved_part_moves_in_the_picture(renderer, scene, make_plant):
    here, there = (make_plant(scene, position=(0.65, y, None)) for y in (0.0, 0.1))
    changed = (renderer.frame(here.state) != renderer.frame(there.state)).any(axis=2)
    # The part covers some per cent of the picture; all else stays as it was.
    assert 0.003 < changed.mean() < 0.2
    same = renderer.frame(here.state)
    np.testing.assert_array_equal(same, renderer.frame(here.state))


def test_a_close_up_is_another_picture(renderer, scene, make_plant):
    state = make_plant(scene).state
    near = renderer.frame(state, close_up([0.65, 0.0, 0.1]))
    assert (near != renderer.frame(state)).any()


def test_refuses_pictures_larger_than_the_buffer(scene):
    with pytest.raises(ValueError, match="1920"):
        Renderer(scene, width=4000, height=100)


# What the dynamic linker does where libEGL is missing, and a driver list without an entry where Mesa is.
_NO_EGL = """
import ctypes, ctypes.util
original = ctypes.CDLL
def refuse(name, *args, **kwargs):
    if name and "EGL" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    return original(name, *args, **kwargs)
ctypes.CDLL = refuse
ctypes.util.find_library = lambda name: None
"""
_NO_DRIVER = "from dyngrasp.simulation import gl_backend\ngl_backend._has_device = lambda egl: False\n"

_TRY = """
from dyngrasp.errors import RenderingUnavailable
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.simulation.rendering import Renderer
from dyngrasp.simulation.scene import build_scene
import mujoco
scene = build_scene(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"))
mujoco.mj_step(scene.model, mujoco.MjData(scene.model))
try:
    Renderer(scene)
except RenderingUnavailable as error:
    print(error)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL is how Linux draws off screen")
@pytest.mark.parametrize(("machine", "package"), [(_NO_EGL, "libegl1"), (_NO_DRIVER, "libgl1-mesa-dri")])
def test_a_machine_without_a_driver_simulates_and_names_the_package(machine, package):
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    result = subprocess.run(
        [sys.executable, "-c", machine + _TRY], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr
    assert package in result.stdout
