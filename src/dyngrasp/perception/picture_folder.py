"""A folder of pictures and the table that says when each was taken and how the arm stood: `frames.csv`.

    picture,t_capture_s,t_receipt_s,A1_rad,A2_rad,…
    0000.png,0.0010,0.0140,0.9599,0.6894,…

Angles are in radians (`_rad`) or degrees (`_deg`), one column a joint; other columns are left alone. Without
`t_receipt_s` a picture counts as there when it was taken.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngrasp.errors import InputFileError
from dyngrasp.signals import Array, read_only

TABLE = "frames.csv"


@dataclass(frozen=True, eq=False)
class TakenPicture:
    """One row of the table.

    Attributes:
        path: Of the picture.
        t_capture, t_receipt: Middle of the exposure, and when the picture had been worked out (s).
        arm_position: (n,) at the capture (rad).
    """

    path: Path
    t_capture: float
    t_receipt: float
    arm_position: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "arm_position", read_only(self.arm_position, (-1,)))


def read_table(folder: str | Path, joints: Sequence[str]) -> tuple[TakenPicture, ...]:
    """The pictures of a folder, by time of receipt.

    Args:
        folder: Holds `frames.csv` and the pictures that it names.
        joints: Names of the arm's joints.

    Raises:
        InputFileError: The table is missing, lacks a column, or holds something that is no number.
    """
    path = Path(folder) / TABLE
    rows = _rows(path)
    postures = _postures(path, rows, joints)
    if "t_capture_s" not in rows[0]:
        raise InputFileError(path, "t_capture_s", None, "this column is missing")
    pictures = []
    for i, (row, (picture, angles)) in enumerate(zip(rows, postures, strict=True)):
        t = _number(path, i, "t_capture_s", row)
        receipt = _number(path, i, "t_receipt_s", row) if "t_receipt_s" in row else t
        if receipt < t:
            raise InputFileError(path, f"row {i + 1}: t_receipt_s", receipt, f"at least the time of capture, {t} s")
        pictures.append(TakenPicture(picture, t, receipt, angles))
    return tuple(sorted(pictures, key=lambda picture: picture.t_receipt))


def read_postures(folder: str | Path, joints: Sequence[str]) -> tuple[tuple[Path, Array], ...]:
    """Pictures of an arm at rest, in the order of the table: it needs no times.

    Args:
        folder: Holds `frames.csv` and the pictures that it names.
        joints: Names of the arm's joints.

    Returns:
        Path of each picture, and the (n,) angles at which it was taken (rad).

    Raises:
        InputFileError: As for `read_table`.
    """
    path = Path(folder) / TABLE
    return tuple(_postures(path, _rows(path), joints))


def table(pictures: Iterable[TakenPicture], joints: Sequence[str]) -> str:
    """The contents of `frames.csv`; reading them gives the same numbers to the last bit."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["picture", "t_capture_s", "t_receipt_s", *(f"{joint}_rad" for joint in joints)])
    for picture in pictures:
        numbers = (picture.t_capture, picture.t_receipt, *picture.arm_position)
        writer.writerow([picture.path.name, *(repr(float(number)) for number in numbers)])
    return text.getvalue()


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        # utf-8-sig: spreadsheets put a mark before the first column's name.
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    except OSError as error:
        raise InputFileError(path, None, None, f"cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputFileError(path, None, None, f"is no table of comma-separated values: {error}") from error
    if not rows:
        raise InputFileError(path, None, None, "a line of names and at least one row expected")
    return rows


def _postures(path: Path, rows: list[dict[str, str]], joints: Sequence[str]) -> list[tuple[Path, Array]]:
    names = set(rows[0])
    columns = [_joint_column(path, joint, names) for joint in joints]
    if "picture" not in names:
        raise InputFileError(path, "picture", None, "this column is missing")
    postures = []
    for i, row in enumerate(rows):
        angles = [scale * _number(path, i, name, row) for name, scale in columns]
        if not row["picture"]:
            raise InputFileError(path, f"row {i + 1}: picture", row["picture"], "expected the name of a file")
        postures.append((path.parent / row["picture"], np.array(angles)))
    return postures


def _joint_column(path: Path, joint: str, names: set[str]) -> tuple[str, float]:
    for suffix, scale in (("rad", 1.0), ("deg", math.pi / 180.0)):
        if f"{joint}_{suffix}" in names:
            return f"{joint}_{suffix}", scale
    raise InputFileError(path, f"{joint}_rad", None, f"a column {joint}_rad or {joint}_deg is missing")


def _number(path: Path, i: int, name: str, row: dict[str, str]) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise InputFileError(path, f"row {i + 1}: {name}", row[name], "a finite number expected")
    return value
