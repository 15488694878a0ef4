"""Where numbers come from: the machine and the versions that every result is written with."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from dyngrasp import __version__

# What may change a number; the rest is in the lock file.
_PACKAGES = ("numpy", "scipy", "numba", "pin", "casadi", "mujoco", "coal")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that compute."""
    found = {"dyngrasp": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, str | int]:
    """Processor, cores and operating system; no name by which the machine could be found."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count() or 1,
        "system": platform.system(),
        "architecture": platform.machine(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
