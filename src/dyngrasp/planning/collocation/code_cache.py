"""Shared libraries compiled once by the machine's C compiler and kept in the user's cache folder.

An entry is named by a hash of everything that its code depends on, and by the digest of its own content: a file that
was damaged no longer fits its name and is built again. Files appear by renaming, so that two processes may build the
same entry at once. Nothing is loaded but what this module built, from a folder that only its owner can write to.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

COMPILER_VARIABLE = "DYNGRASP_COMPILER"
"""Environment variable that names the C compiler; the empty string means: use none."""

CACHE_VERSION = "1"
COMPILE_TIMEOUT = 300.0  # seconds; the largest function of a seven-joint arm takes three

_log = logging.getLogger(__name__)
_libraries: dict[str, ctypes.CDLL] = {}


class CompilationError(Exception):
    """The compiler is missing or refuses; callers fall back to another way of evaluation."""


def compiler() -> tuple[str, ...] | None:
    """The command of the C compiler, None if there is none or none is wanted."""
    return _found(os.environ.get(COMPILER_VARIABLE), os.environ.get("PATH"))


@functools.cache
def _found(wanted: str | None, path: str | None) -> tuple[str, ...] | None:
    """The command in these circumstances: looked for once, as it is asked for in every solve."""
    if wanted is not None:
        command = tuple(shlex.split(wanted))
        return command if command and shutil.which(command[0], path=path) else None
    found = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name, path=path))), None)
    return (found,) if found else None


def cache_folder() -> Path:
    """The folder of compiled code; made readable and writable for its owner only.

    Without a usable one, a private temporary folder that lasts as long as the process.
    """
    if sys.platform == "darwin":
        default = Path.home() / "Library" / "Caches"
    else:
        default = Path.home() / ".cache"
    folder = Path(os.environ.get("XDG_CACHE_HOME") or default) / "dyngrasp" / "code"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.stat()
        private = state.st_uid == os.getuid() and not state.st_mode & 0o022
        if private and os.access(folder, os.W_OK | os.X_OK):
            return folder
        _log.warning("%s is not private to its user; compiled code is not kept", folder)
    except OSError as error:
        _log.warning("%s cannot be used (%s); compiled code is not kept", folder, error.strerror)
    return _private_folder()


def load(source: str, description: str) -> ctypes.CDLL:
    """The compiled form of a C source, built if it is not in the cache.

    Args:
        source: C99 that needs nothing but the mathematical library.
        description: For the message on first use.

    Raises:
        CompilationError: No compiler, or it failed.
    """
    command = compiler()
    if command is None:
        raise CompilationError("no C compiler")
    identity = (CACHE_VERSION, " ".join(command), _version(command), _processor(), " ".join(_FLAGS), source)
    key = hashlib.sha256("\0".join(identity).encode()).hexdigest()[:32]
    if key not in _libraries:
        folder = cache_folder()
        _libraries[key] = _from_cache(folder, key) or _build(command, source, description, folder, key)
    return _libraries[key]


# The processor is part of the hash, so that code made for it never meets another. Contraction to fused multiply-add
# and reordering change results in the last digit only; errno and traps of mathematical functions are not used.
_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared")
_PORTABLE_FLAGS = ("-O2", "-fPIC", "-shared")


def _from_cache(folder: Path, key: str) -> ctypes.CDLL | None:
    for path in sorted(folder.glob(f"{key}-*.so")):
        try:
            intact = path.name == _name(key, path.read_bytes())
            if intact:
                return ctypes.CDLL(str(path))
        except OSError:
            pass
        path.unlink(missing_ok=True)
    return None


def _build(command: tuple[str, ...], source: str, description: str, folder: Path, key: str) -> ctypes.CDLL:
    _log.warning("compiling %s (once, some seconds)", description)
    with tempfile.TemporaryDirectory(dir=folder, prefix="build-") as work:
        c_file, library = Path(work) / "code.c", Path(work) / "code.so"
        c_file.write_text(source, encoding="utf-8")
        failure = ""
        for flags in (_FLAGS, _PORTABLE_FLAGS):
            failure = _run([*command, *flags, str(c_file), "-o", str(library), "-lm"])
            if not failure:
                break
        if failure:
            raise CompilationError(f"{' '.join(command)}: {failure}")
        path = folder / _name(key, library.read_bytes())
        os.replace(library, path)
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise CompilationError(f"what {' '.join(command)} made cannot be loaded: {error}") from error


def _run(command: list[str]) -> str:
    """What went wrong, "" if nothing."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=COMPILE_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    return next(iter(done.stderr.strip().splitlines()), f"exit status {done.returncode}")


def _name(key: str, content: bytes) -> str:
    return f"{key}-{hashlib.sha256(content).hexdigest()[:32]}.so"


@functools.lru_cache(maxsize=8)
def _version(command: tuple[str, ...]) -> str:
    try:
        done = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilationError(f"{' '.join(command)}: {error}") from error
    return done.stdout


@functools.lru_cache(maxsize=1)
def _processor() -> str:
    """What distinguishes processors for which `-march=native` makes different code."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    wanted = ("model name", "flags", "Features", "CPU part")
    first = {line.split(":")[0].strip(): line for line in reversed(lines) if line.startswith(wanted)}
    return "\n".join([platform.system(), platform.machine(), platform.processor(), *sorted(first.values())])


@functools.lru_cache(maxsize=1)
def _private_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="dyngrasp-code-"))
