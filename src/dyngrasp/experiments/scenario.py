"""What is to be run: a scenario file, decoded strictly, with overrides from the command line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from dyngrasp.errors import ModelFileError, ScenarioError
from dyngrasp.experiments.scenario_values import (
    Coordinate,
    Degrees,
    PositiveRange,
    Range,
    Spread,
    Yaw,
    settings_schema,
)
from dyngrasp.models.model_file import Finite, NonNegative, StrictSchema, decode, read_toml
from dyngrasp.planning.grasp_task import TaskSettings

__all__ = [
    "CameraSection",
    "ConveyorSection",
    "Scenario",
    "PartSection",
    "PlannerSection",
    "PlantSection",
    "PoseSection",
    "RelocationSection",
    "RenderSection",
    "ReplannerSection",
    "TaskSection",
    "load_scenario",
]

OVERRIDE = "--set"
"""What errors name in place of a file when the offending value came from an override."""

_MODEL_KEYS = {"task": ("robot", "gripper", "object"), "camera": ("model",)}


_TaskSettingsSection = settings_schema(TaskSettings)


class TaskSection(StrictSchema):
    """`[task]`: arm, gripper and part, by name or by path of a model file, and where the motion begins and ends.

    `start_deg` and `place_deg` hold one angle a joint. `settings` overrides fields of `TaskSettings`, in SI units.
    """

    robot: str
    gripper: str
    object: str
    start_deg: Annotated[tuple[Degrees, ...], Field(min_length=1)]
    place_deg: Annotated[tuple[Degrees, ...], Field(min_length=1)]
    settings: _TaskSettingsSection = _TaskSettingsSection()  # type: ignore[valid-type]

    @property
    def task_settings(self) -> TaskSettings:
        """The settings of the task."""
        return TaskSettings(**self.settings.model_dump())  # type: ignore[attr-defined]


class PartSection(StrictSchema):
    """`[part]`: where the part lies; each key a number or a range from which each trial draws.

    `yaw_deg = "any"` is a whole turn. Without `z_m` the part stands on the ground.
    """

    x_m: Coordinate
    y_m: Coordinate
    yaw_deg: Yaw
    z_m: Coordinate | None = None


class ConveyorSection(StrictSchema):
    """`[conveyor]`: the part stands on a plate that slides in the ground and carries it; `[part]` is where it starts.

    The planner is told the speed and heading with which the part starts, the speed off by up to `speed_error`, a
    fraction; how much of that is revealed on the way, `[pose]` says as for the pose. `heading_deg` counts from the
    world's x axis to its y axis.
    """

    speed_m_s: PositiveRange
    heading_deg: Range = (90.0, 90.0)
    speed_error: Spread = 0.0


class RelocationSection(StrictSchema):
    """`[relocation]`: the part is moved away while the arm is under way, and nobody tells the planner.

    It stands on a plate that slides in the ground, by `distance_mm` in the direction `heading_deg` (from the world's x
    axis to its y axis), smoothly from `at_s` on, within `within_s`. Times count from the beginning of the episode, the
    first look included.
    """

    distance_mm: PositiveRange
    at_s: PositiveRange
    within_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.3
    heading_deg: Range = (-180.0, 180.0)


class PlannerSection(StrictSchema):
    """`[planner]`: `effort_weight` is ρ of eq. (3a) in s⁴/rad² (the paper: 1), `intervals` is N."""

    backend: Literal["structured", "ipopt"] = "structured"
    effort_weight: NonNegative = 1.0
    intervals: Annotated[int, Field(ge=4, le=1000)] = 100


class PoseSection(StrictSchema):
    """`[pose]`: how far the pose that the planner gets is off the true one.

    With `source = "noise"` each trial draws an error of the translation uniformly from a ball of radius `position_mm`
    and a turn about a random axis by up to `rotation_deg`, about the grasp point. `along_mm`, `across_mm` and `up_mm`
    are added on top, in the grasp frame (x along the rib, y across it, z outward); with `random_sign` each trial draws
    their signs. With `draw = "planar"` the error is exactly `position_mm` in a random horizontal direction and exactly
    `rotation_deg` about the vertical, to either side.

    With `source = "camera"` nothing is known at first: the arm waits where the motion starts while the camera of the
    table `[camera]` takes a first look, the grasp is planned for what it saw, and pictures tell the replanner the rest.
    `motion` says what is known of the part beforehand: whether its velocity is estimated at all. All other keys are for
    `"noise"`, the last of them for what a camera would reveal, see `PoseNoiseSettings`; their defaults are fitted to
    the rendered camera.
    """

    source: Literal["truth", "noise", "camera"] = "truth"
    motion: Literal["still", "constant_velocity"] = "still"
    position_mm: NonNegative = 0.0
    rotation_deg: NonNegative = 0.0
    along_mm: Finite = 0.0
    across_mm: Finite = 0.0
    up_mm: Finite = 0.0
    random_sign: bool = True
    draw: Literal["ball", "planar"] = "ball"
    reveal_from_m: NonNegative = 0.40
    reveal_to_m: NonNegative = 0.15
    residual_mm: NonNegative = 0.9
    residual_deg: NonNegative = 0.3
    frame_mm: NonNegative = 0.03
    frame_mm_per_m2: NonNegative = 1.7
    frame_deg: NonNegative = 0.04
    frame_deg_per_m2: NonNegative = 1.8
    correlation_s: NonNegative = 1.4
    frame_mm_s: NonNegative = 1.0
    frame_deg_s: NonNegative = 0.1

    @model_validator(mode="after")
    def _truth_is_exact(self) -> Self:
        if self.source == "truth" and any(
            (self.position_mm, self.rotation_deg, self.along_mm, self.across_mm, self.up_mm)
        ):
            raise ValueError('no errors with source = "truth"; set source = "noise"')
        return self


class CameraSection(StrictSchema):
    """`[camera]`: pictures of the running simulation, for `pose.source = "camera"`.

    Without `width` and `height` they are as large as the camera's own. `exposures` moments of each exposure are drawn
    and averaged, which is its motion blur. `latency_ms` is from the end of the exposure to the pose in the filter. Each
    trial draws an error of the calibrated mount, of `mount_mm` and `mount_deg` in a random direction. The first look,
    taken from `task.start_deg`, ends when the grasp point is known to `look_mm` (one standard deviation) and
    `look_least_s` have passed, or after `look_s`. `dyngrasp run` keeps one picture of `keep_every`; 0 keeps none.
    """

    model: str = "ava1000"
    width: Annotated[int, Field(ge=64, le=4096)] | None = None
    height: Annotated[int, Field(ge=64, le=4096)] | None = None
    exposures: Annotated[int, Field(ge=1, le=32)] = 1
    latency_ms: NonNegative = 12.0
    brightness: Annotated[float, Field(gt=0.0, le=10.0)] = 1.0
    noise: NonNegative = 1.5
    vignetting: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    mount_mm: NonNegative = 0.0
    mount_deg: NonNegative = 0.0
    look_mm: Annotated[float, Field(gt=0.0)] = 2.0
    look_least_s: NonNegative = 0.0
    look_s: Annotated[float, Field(gt=0.0, le=60.0)] = 2.0
    keep_every: Annotated[int, Field(ge=0)] = 3

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.width is None) != (self.height is None):
            raise ValueError("width and height: both or neither")
        if self.look_least_s > self.look_s:
            raise ValueError("look_least_s: at most look_s")
        return self


class ReplannerSection(StrictSchema):
    """`[replanner]`: whether the plan is replaced as the pose becomes known, how often (Hz), and how fast.

    `latency_ms` is the time from question to answer, `"measured"` what it really takes on this machine; what takes
    longer than `budget_ms` is discarded. `mode = "lcqp"` is the paper's program and update, published unchecked. While
    a camera, or a source of the user's, knows the grasp point worse than to `largest_deviation_mm` (one standard
    deviation), its updates are not taken; the noise model's are.
    """

    enabled: bool = False
    rate_hz: Annotated[float, Field(gt=0.0, le=100.0)] = 10.0
    budget_ms: Annotated[float, Field(gt=0.0, le=100.0)] = 20.0
    latency_ms: NonNegative | Literal["measured"] = 20.0
    mode: Literal["exact", "lcqp"] = "exact"
    largest_deviation_mm: Annotated[float, Field(gt=0.0)] = 5.0


class PlantSection(StrictSchema):
    """`[plant]`: how the simulated plant differs from the models, see `PlantVariation.draw`.

    `friction` is the sliding friction between pad and part; the torsional one is `torsional_over_sliding_m` times that.
    The spreads are fractions: `mass_spread = 0.1` draws the part's mass within ±10 %.
    """

    control_rate_hz: Annotated[float, Field(ge=500.0, le=20000.0)] = 1000.0
    friction: PositiveRange = (0.6, 0.9)
    torsional_over_sliding_m: NonNegative = 0.0125
    mass_spread: Spread = 0.1
    armature_spread: Spread = 0.2
    joint_friction_spread: Spread = 0.2


class RenderSection(StrictSchema):
    """`[render]`: the video of `dyngrasp run`."""

    video: bool = True
    frames_per_second: Annotated[float, Field(gt=0.0, le=240.0)] = 20.0
    width: Annotated[int, Field(ge=64, le=4096, multiple_of=2)] = 960
    height: Annotated[int, Field(ge=64, le=4096, multiple_of=2)] = 540


class Scenario(StrictSchema):
    """One scenario file. Units are in the names of the keys; `[task.settings]` is in SI units throughout."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    description: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    task: TaskSection
    part: PartSection
    conveyor: ConveyorSection | None = None
    relocation: RelocationSection | None = None
    planner: PlannerSection = PlannerSection()
    pose: PoseSection = PoseSection()
    camera: CameraSection = CameraSection()
    replanner: ReplannerSection = ReplannerSection()
    plant: PlantSection = PlantSection()
    render: RenderSection = RenderSection()

    @model_validator(mode="after")
    def _one_plate(self) -> Self:
        if self.conveyor is not None and self.relocation is not None:
            raise ValueError("conveyor and relocation: one of them; the part stands on one plate")
        return self


def load_scenario(path: str | Path, overrides: list[str] | tuple[str, ...] = ()) -> Scenario:
    """Read a scenario file and apply overrides.

    A file may begin with `extends = "other.toml"`, a path relative to itself: its own keys then go over the other's,
    table by table. Paths of models are relative to the file that names them, in an override to the working directory.

    Args:
        path: The TOML file.
        overrides: `key=value` with a dotted key and a TOML value; a plain word needs no quotes.

    Raises:
        ScenarioError: Names the file (or `--set`), the key, its value, and what would be valid.
    """
    document = _read(Path(path), ())
    overridden = [_apply(document, text) for text in overrides]
    try:
        return decode(Scenario, document, path)
    except ModelFileError as error:
        key = error.key or ""
        from_override = any(
            key == o or key.startswith((f"{o}.", f"{o}[")) or o.startswith(f"{key}.") for o in overridden
        )
        raise ScenarioError(OVERRIDE if from_override else path, error.key, error.value, error.expected) from error


def _read(path: Path, chain: tuple[Path, ...]) -> dict[str, Any]:
    if path.resolve() in chain:
        raise ScenarioError(chain[-1], "extends", str(path), "must not lead back to a file that extends this one")
    try:
        document = read_toml(path)
    except ModelFileError as error:
        raise ScenarioError(error.file, error.key, error.value, error.expected) from error
    for name, keys in _MODEL_KEYS.items():
        table = document.get(name)
        if isinstance(table, dict):
            table |= {key: _resolved(table[key], path.parent) for key in keys if key in table}
    parent = document.pop("extends", None)
    if parent is None:
        return document
    if not isinstance(parent, str):
        raise ScenarioError(path, "extends", parent, "must be the path of a scenario file")
    return _merged(_read(path.parent / parent, (*chain, path.resolve())), document)


def _resolved(model: Any, folder: Path) -> Any:
    """Names of the catalogue stay, paths become independent of the working directory."""
    return str(folder / model) if isinstance(model, str) and model.endswith(".toml") else model


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both_tables = isinstance(value, dict) and isinstance(below.get(key), dict)
        merged[key] = _merged(below[key], value) if both_tables else value
    return merged


def _apply(document: dict[str, Any], override: str) -> str:
    """Put one `key=value` into the document; returns the dotted key."""
    key, separator, text = override.partition("=")
    key = key.strip()
    if not separator or not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", key):
        raise ScenarioError(OVERRIDE, None, None, f"expected key=value with a dotted key, got {override!r}")
    *tables, last = key.split(".")
    here = document
    for depth, table in enumerate(tables):
        here = here.setdefault(table, {})
        if not isinstance(here, dict):
            raise ScenarioError(OVERRIDE, key, text, f"`{'.'.join(tables[: depth + 1])}` is a value, not a table")
    value = _value(key, text.strip())
    if len(tables) == 1 and last in _MODEL_KEYS.get(tables[0], ()):
        value = _resolved(value, Path.cwd())
    here[last] = value
    return key


def _value(key: str, text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        # The shell takes the quotes off strings, so a plain word or path is accepted without them.
        if re.fullmatch(r"[A-Za-z_./~][\w./~+-]*", text):
            return text
    raise ScenarioError(OVERRIDE, key, text, 'expected a TOML value: a number, true, [1, 2] or "text"')
