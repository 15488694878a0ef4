"""Strict decoding: what is refused, and what the refusal says."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngrasp.errors import ModelFileError
from dyngrasp.models.model_file import (
    Finite,
    NonNegative,
    Positive,
    StrictSchema,
    UnitQuaternion,
    Vector3,
    decode,
    read_toml,
)


class Limb(StrictSchema):
    name: str
    length: Positive
    direction: Vector3 = (0.0, 0.0, 1.0)
    quat_wxyz: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)


class Settings(StrictSchema):
    damping: NonNegative = 0.0
    offset: Finite = 0.0


class Creature(StrictSchema):
    name: str
    limbs: tuple[Limb, ...]
    settings: Settings | None = None


FILE = Path("creature/model.toml")


def creature(**limb: object) -> dict[str, object]:
    return {"name": "newt", "limbs": [{"name": "a", "length": 1.0}, {"name": "b", "length": 2.0, **limb}]}


def refusal(data: dict[str, object]) -> ModelFileError:
    with pytest.raises(ModelFileError) as caught:
        decode(Creature, data, FILE)
    assert "creature/model.toml" in str(caught.value)
    return caught.value


def test_valid_table_is_decoded_and_frozen():
    data = creature(direction=[1, 0, 0])
    decoded = decode(Creature, data, FILE)
    assert decoded.limbs[1].direction == (1.0, 0.0, 0.0)
    assert decoded.limbs[0].length == 1.0
    with pytest.raises(Exception, match="frozen"):
        decoded.limbs[0].length = 3.0  # pyright: ignore[reportAttributeAccessIssue]


def test_unknown_key_lists_the_valid_ones_of_its_own_table():
    error = refusal(creature(lenght=3.0))
    assert error.key == "limbs[1].lenght"
    for valid in ("name", "length", "direction", "quat_wxyz"):
        assert valid in error.expected
    assert "limbs" not in error.expected


def test_unknown_key_inside_an_optional_table():
    error = refusal({**creature(), "settings": {"dampening": 1.0}})
    assert error.key == "settings.dampening"
    assert "damping" in error.expected
    assert "offset" in error.expected


def test_unknown_key_wins_over_the_missing_one_it_was_meant_for():
    error = refusal({"nmae": "newt", "limbs": []})
    assert error.key == "nmae"
    assert "name" in error.expected


def test_missing_key_is_named():
    error = refusal({"name": "newt", "limbs": [{"name": "a"}]})
    assert error.key == "limbs[0].length"
    assert "missing" in error.expected


@pytest.mark.parametrize("length", [0.0, -1.0, float("nan"), float("inf"), "1.0", True])
def test_length_must_be_a_positive_finite_number(length: object):
    error = refusal(creature(length=length))
    assert error.key == "limbs[1].length"
    assert repr(error.value) == repr(length)


@pytest.mark.parametrize("direction", [[1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [1.0, float("nan"), 0.0], "xyz"])
def test_vector_needs_three_finite_numbers(direction: object):
    assert str(refusal(creature(direction=direction)).key).startswith("limbs[1].direction")


@pytest.mark.parametrize("quaternion", [[1.0, 0.0, 0.0, 1e-2], [0.0, 0.0, 0.0, 0.0], [1.0 + 2e-6, 0.0, 0.0, 0.0]])
def test_quaternion_must_be_of_unit_norm(quaternion: list[float]):
    error = refusal(creature(quat_wxyz=quaternion))
    assert error.key == "limbs[1].quat_wxyz"
    assert "unit" in error.expected


def test_quaternion_rounded_to_seven_digits_passes():
    decode(Creature, creature(quat_wxyz=[0.7071068, 0.7071068, 0.0, 0.0]), FILE)


def test_missing_file(tmp_path: Path):
    with pytest.raises(ModelFileError, match=r"absent\.toml"):
        read_toml(tmp_path / "absent.toml")


def test_folder_instead_of_a_file(tmp_path: Path):
    with pytest.raises(ModelFileError):
        read_toml(tmp_path)


def test_malformed_toml_names_the_line(tmp_path: Path):
    path = tmp_path / "model.toml"
    path.write_text('name = "a"\nmass = = 2\n')
    with pytest.raises(ModelFileError, match="line 2"):
        read_toml(path)


def test_bytes_that_are_not_text(tmp_path: Path):
    path = tmp_path / "model.toml"
    path.write_bytes(b"name = \xff\xfe")
    with pytest.raises(ModelFileError, match="UTF-8"):
        read_toml(path)


def test_reads_what_is_there(tmp_path: Path):
    path = tmp_path / "model.toml"
    path.write_text('name = "a"\n[limit]\nspeed = 2\n')
    assert read_toml(path) == {"name": "a", "limit": {"speed": 2}}
