"""Strict decoding of the TOML files that hold physical facts.

Every model (robot, gripper, object) is described by one ``model.toml``. Each kind has its own schema, a subclass of
:class:`StrictSchema`; what all of them share is here: reading the file, refusing what the schema does not know, and
turning any complaint into one :class:`~dyngrasp.errors.ModelFileError` that names file, key, value and what is valid.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import numpy as np
import pinocchio as pin
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from dyngrasp.errors import ModelFileError

__all__ = [
    "Finite",
    "Positive",
    "NonNegative",
    "Vector3",
    "UnitQuaternion",
    "StrictSchema",
    "PoseTable",
    "read_toml",
    "decode",
]

UNIT_QUATERNION_TOLERANCE = 1e-6
"""Largest deviation of a quaternion's norm from one: a file with six digits passes, an unscaled one does not."""

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Vector3 = tuple[Finite, Finite, Finite]


def _require_unit(quat_wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.sqrt(sum(component * component for component in quat_wxyz))
    if abs(norm - 1.0) > UNIT_QUATERNION_TOLERANCE:
        raise ValueError(f"a unit quaternion (w, x, y, z); its norm is {norm:.9g}")
    return quat_wxyz


UnitQuaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_require_unit)]
"""Four components in the order w, x, y, z, of norm one to :data:`UNIT_QUATERNION_TOLERANCE`."""


class StrictSchema(BaseModel):
    """Base of all file schemas: unknown keys are errors, values are not coerced, instances are frozen.

    TOML writes ``1`` where ``1.0`` is meant, so an integer is accepted for a float; nothing else is converted.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class PoseTable(StrictSchema):
    """Where a frame is in another one: `position` (m) and `quat_wxyz`."""

    position: Vector3
    quat_wxyz: UnitQuaternion

    @property
    def pose(self) -> pin.SE3:
        """The same with the rounding taken off the quaternion."""
        w, x, y, z = self.quat_wxyz
        return pin.SE3(pin.Quaternion(w, x, y, z).normalized().matrix(), np.array(self.position))


SchemaT = TypeVar("SchemaT", bound=BaseModel)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read one TOML file.

    Args:
        path: The file to read.

    Returns:
        Its top-level table.

    Raises:
        ModelFileError: The file does not exist, cannot be read, or is not valid TOML.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ModelFileError(path, None, None, f"expected a readable file ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ModelFileError(path, None, None, f"expected UTF-8 text ({error})") from error
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ModelFileError(path, None, None, f"expected a valid TOML document ({error})") from error


def decode(schema: type[SchemaT], data: dict[str, Any], path: str | Path) -> SchemaT:
    """Decode a table strictly into a schema.

    Args:
        schema: The pydantic model that describes the file; use subclasses of :class:`StrictSchema`.
        data: The table, as :func:`read_toml` returns it.
        path: The file the table came from; it is only named in the error.

    Returns:
        The validated instance.

    Raises:
        ModelFileError: For the first offence: an unknown or missing key, a wrong type, a number out of range, NaN or
            infinity. ``key`` is the dotted path with list indices, such as ``grasps[1].width``.
    """
    # TOML arrays arrive as lists; strict mode takes tuples only from tuples, and a frozen schema holds tuples.
    tupled = {name: _lists_to_tuples(value) for name, value in data.items()}
    try:
        return schema.model_validate(tupled)
    except ValidationError as error:
        raise _first_offence(error, schema, data, Path(path)) from error


def _lists_to_tuples(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_lists_to_tuples(item) for item in value)
    if isinstance(value, dict):
        return {name: _lists_to_tuples(item) for name, item in value.items()}
    return value


def _first_offence(error: ValidationError, schema: type[BaseModel], data: dict[str, Any], path: Path) -> ModelFileError:
    offences = error.errors(include_url=False)
    # An unknown key is usually the misspelling of a missing one; naming it says more than "missing" does.
    offence = next((item for item in offences if item["type"] == "extra_forbidden"), offences[0])
    location = _keys_in_file(offence["loc"], data, missing=offence["type"] == "missing")
    if offence["type"] == "extra_forbidden":
        valid = _valid_keys(schema, offence["loc"][:-1])
        near = difflib.get_close_matches(str(offence["loc"][-1]), valid, n=1)
        hint = f"did you mean `{near[0]}`? " if near else ""
        expected = f"no such key; {hint}valid: " + ", ".join(valid)
    elif offence["type"] == "missing":
        expected = "the key is missing"
    else:
        message = str(offence["msg"])
        for prefix in ("Value error, ", "Input should be "):
            message = message.removeprefix(prefix)
        expected = f"expected {message}"
    value = None if offence["type"] == "missing" else offence["input"]
    return ModelFileError(path, _dotted(location), value, expected)


def _keys_in_file(location: tuple[int | str, ...], data: dict[str, Any], *, missing: bool) -> tuple[int | str, ...]:
    """Drop the parts of a pydantic location that name union members instead of keys of the file."""
    found: list[int | str] = []
    here: Any = data
    part: Any
    for position, part in enumerate(location):
        if (isinstance(here, dict) and part in here) or (isinstance(here, list) and isinstance(part, int)):
            found.append(part)
            inside = isinstance(here, dict) or (isinstance(part, int) and part < len(here))
            here = here[part] if inside else None
        elif (missing and position == len(location) - 1) or isinstance(part, int):
            found.append(part)
    return tuple(found)


def _dotted(location: tuple[int | str, ...]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else (f".{part}" if text else str(part))
    return text


def _valid_keys(schema: Any, location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that are known at a location, looking through lists, options and unions."""
    candidates: list[Any] = [schema]
    for part in location:
        candidates = [child for candidate in candidates for child in _children(candidate, part)]
    models = [model for candidate in candidates for model in _models(candidate)]
    return sorted({field.alias or name for model in models for name, field in model.model_fields.items()})


def _children(annotation: Any, part: int | str) -> list[Any]:
    children: list[Any] = []
    for model in _models(annotation):
        for name, field in model.model_fields.items():
            if part in (name, field.alias):
                children.append(field.annotation)
    # An integer indexes a list whose item type _models already reaches through; a union tag names the same candidates.
    return children or [annotation]


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Annotated, Union, UnionType, tuple, list, dict):
        return [model for argument in get_args(annotation) for model in _models(argument)]
    return []
