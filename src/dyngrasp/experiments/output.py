"""Files that appear whole or not at all, in folders found writable before the work begins."""

from __future__ import annotations

import contextlib
import json
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from dyngrasp.errors import DyngraspError


class OutputError(DyngraspError):
    """A folder or file that was named for output cannot be written.

    Args:
        path: The path as the user named it.
        reason: Why not, in words.
    """

    def __init__(self, path: str | Path, reason: str) -> None:
        self.path, self.reason = str(path), reason
        super().__init__(f"{path}: cannot be written: {reason}")


class OutputFolder:
    """A folder that is made, and tried, before anything long begins.

    Used as a context manager it leaves no empty folder behind if the work ends in an exception.

    Args:
        path: The folder; parents are made as needed.

    Raises:
        OutputError: It cannot be made, is no folder, or no file can be written into it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        missing = [folder for folder in (self.path, *self.path.parents) if not folder.exists()]
        self._made: list[Path] = []
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._made = missing
            with tempfile.NamedTemporaryFile(dir=self.path, prefix=".probe-"):
                pass
        except OSError as error:
            self._remove_empty()
            raise OutputError(path, _reason(error)) from error

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __enter__(self) -> OutputFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._remove_empty()

    def _remove_empty(self) -> None:
        for folder in self._made:
            with contextlib.suppress(OSError):
                folder.rmdir()


def check_writable(path: str | Path) -> None:
    """Make sure that a file can be put at `path`, without putting one.

    Raises:
        OutputError: The folder does not exist, is not writable, or `path` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise OutputError(path, "it is a folder")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".probe-"):
            pass
    except OSError as error:
        raise OutputError(path, _reason(error)) from error


@contextlib.contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends well, and vanishes when it does not.

    The temporary name keeps the suffix, for writers that choose the format by it.

    Raises:
        OutputError: The file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(path, _reason(error)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, document: Any) -> None:
    """Write a document as strict JSON; a number that is not finite becomes `null`: JSON has no word for it."""
    with atomic(path) as temporary:
        text = json.dumps(_strict(document), indent=1, allow_nan=False, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return _strict(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
