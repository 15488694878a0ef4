"""Kinds of values that stand in a scenario file, with what each may be."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, create_model, model_validator

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.model_file import Finite, NonNegative, StrictSchema


def _as_range(value: Any) -> Any:
    return (value, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"a number or [low, high] with low ≤ high; {value[0]:g} > {value[1]:g}")
    return value


def _positive(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] <= 0:
        raise ValueError(f"a number > 0 or [low, high] with 0 < low ≤ high, got {value[0]:g}")
    return value


def _within_reach_of_any_arm(value: tuple[float, float]) -> tuple[float, float]:
    # Catches millimetres where metres belong; whether this arm reaches that far is for the planner to say.
    if max(abs(value[0]), abs(value[1])) > 10.0:
        raise ValueError("metres, at most 10 from the base")
    return value


def _whole_turns(value: Any) -> Any:
    return (-180.0, 180.0) if value == "any" else _as_range(value)


Range = Annotated[tuple[Finite, Finite], BeforeValidator(_as_range), AfterValidator(_ordered)]
"""A number, or [low, high] from which each trial draws uniformly."""
PositiveRange = Annotated[Range, AfterValidator(_positive)]
Coordinate = Annotated[Range, AfterValidator(_within_reach_of_any_arm)]
Yaw = Annotated[tuple[Finite, Finite], BeforeValidator(_whole_turns), AfterValidator(_ordered)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0, allow_inf_nan=False)]
Spread = Annotated[float, Field(ge=0.0, lt=1.0, allow_inf_nan=False)]


def settings_schema(settings: type) -> type[StrictSchema]:
    """The strict schema of a settings dataclass: the same keys, units and defaults, every number finite and ≥ 0.

    Args:
        settings: A frozen dataclass whose fields are numbers, Booleans and strings with defaults. What it refuses
            itself, the schema refuses too.
    """
    kinds: dict[type, Any] = {float: NonNegative, int: Annotated[int, Field(ge=0)], bool: bool, str: str}
    fields: dict[str, Any] = {}
    for item in dataclasses.fields(settings):
        # Defaults that were computed, such as deg2rad(1), are numpy scalars.
        default: Any = item.default
        default = default.item() if hasattr(default, "item") else default
        if type(default) in kinds:
            fields[item.name] = (kinds[type(default)], default)

    def accepted(section: StrictSchema) -> StrictSchema:
        try:
            settings(**section.model_dump())
        except InvalidProblem as error:
            raise ValueError(f"settings that make sense: {error}") from error
        return section

    validators: dict[str, Any] = {"accepted": model_validator(mode="after")(accepted)}
    return create_model(f"{settings.__name__}Section", __base__=StrictSchema, __validators__=validators, **fields)
