"""Choice of MuJoCo's OpenGL back end, before MuJoCo is imported for the first time."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys

from dyngrasp.errors import RenderingUnavailable


def _egl_library() -> ctypes.CDLL | None:
    for name in ("libEGL.so.1", ctypes.util.find_library("EGL")):
        if name is None:
            continue
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def choose() -> None:
    """Set MUJOCO_GL to "egl" where that library loads, else to "disabled"; what the user has set stays.

    MuJoCo reads the variable once, at import, and with "egl" but no libEGL the import itself fails. Off Linux its own
    default is right and nothing is set.
    """
    if "MUJOCO_GL" in os.environ or not sys.platform.startswith("linux") or "mujoco" in sys.modules:
        return
    os.environ["MUJOCO_GL"] = "egl" if _egl_library() is not None else "disabled"


def require() -> None:
    """Make sure that an off-screen context can be had.

    Raises:
        RenderingUnavailable: Says which Debian package is missing.
    """
    backend = os.environ.get("MUJOCO_GL", "").lower()
    if not sys.platform.startswith("linux") or backend in ("osmesa", "glfw", "glx"):
        return
    egl = _egl_library()
    if egl is None:
        raise RenderingUnavailable(
            "no off-screen rendering: libEGL.so.1 is missing; on Debian or Ubuntu install libegl1"
        )
    if backend != "egl":
        raise RenderingUnavailable(
            f"no off-screen rendering: MuJoCo was loaded with MUJOCO_GL={backend or '(unset)'}; set MUJOCO_GL=egl"
        )
    if not _has_device(egl):
        raise RenderingUnavailable(
            "no off-screen rendering: EGL finds no driver; on Debian or Ubuntu install libgl1-mesa-dri"
        )


def _has_device(egl: ctypes.CDLL) -> bool:
    """Whether EGL lists a device that initialises: what MuJoCo's own start would try, without its assertion."""
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    addresses = [egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")]
    if not all(addresses):
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))(addresses[0])
    display_of = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(addresses[1])
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_int), ctypes.POINTER(ctypes.c_int)]
    egl.eglInitialize.restype = ctypes.c_uint
    count = ctypes.c_int(0)
    devices = (ctypes.c_void_p * 16)()
    if not query(16, ctypes.cast(devices, ctypes.c_void_p), ctypes.byref(count)):
        return False
    platform_device = 0x313F  # EGL_PLATFORM_DEVICE_EXT
    for device in devices[: count.value]:
        display = display_of(platform_device, device, None)
        if display and egl.eglInitialize(display, None, None):
            return True
    return False
