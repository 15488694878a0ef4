"""Mistakes of a user: one clear line on standard error, exit status 2, no traceback, nothing half-written."""

import os
import shutil
from pathlib import Path

import pytest

from dyngrasp.cli import main
from dyngrasp.cli.arguments import BAD_INPUT
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot

SCENARIO = Path(__file__).parents[2] / "scenarios" / "static_sdh2.toml"


@pytest.fixture
def refused(capsys, tmp_path, monkeypatch):
    """Run a command that must be refused; returns the message. No file may appear anywhere it could have."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> str:
        before = {p for p in tmp_path.rglob("*") if p.is_file()}
        status = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        assert status == BAD_INPUT, captured.out + captured.err
        assert "Traceback" not in captured.err + captured.out
        assert captured.err.startswith("dyngrasp: error: ")
        assert captured.err.count("\n") == 1
        assert {p for p in tmp_path.rglob("*") if p.is_file()} == before
        return captured.err

    return run


def plan(refused, *extra: str, scenario: Path | str = SCENARIO) -> str:
    return refused("plan", str(scenario), "--out", "plan.json", *extra)


def test_a_missing_scenario(refused):
    assert "nowhere.toml" in plan(refused, scenario="nowhere.toml")


def test_malformed_toml(refused, tmp_path):
    (tmp_path / "broken.toml").write_text('name = "x\n')
    message = plan(refused, scenario="broken.toml")
    assert "broken.toml" in message
    assert "line 1" in message


def test_an_unknown_key_lists_the_valid_ones(refused, tmp_path):
    (tmp_path / "typo.toml").write_text(SCENARIO.read_text().replace("yaw_deg", "yaw_degree"))
    message = plan(refused, scenario="typo.toml")
    for expected in ("typo.toml", "part.yaw_degree", "did you mean `yaw_deg`", "x_m", "y_m"):
        assert expected in message


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("task.settings.grip_share=1.5", ("task.settings", "grip_share", "at most 1", "1.5")),
        ("part.x=0.6", ("part.x", "x_m", "yaw_deg")),
        ("nonsense", ("key=value",)),
        ("part.x_m=650", ("part.x_m", "650", "metres")),
        ("part.x_m=[0.7, 0.6]", ("part.x_m", "low ≤ high")),
        ("part.x_m=nan", ("part.x_m", "finite")),
        ("planner.effort_weight=-1", ("planner.effort_weight", "-1", "greater than or equal to 0")),
        ("planner.intervals=2", ("planner.intervals", "2", "greater than or equal to 4")),
        ("planner.backend=snopt", ("planner.backend", "snopt", "structured", "ipopt")),
        ("plant.friction=-0.5", ("plant.friction", "-0.5", "> 0")),
        ("task.robot=iiwa15", ("iiwa15", "iiwa14")),
        ("camera.model=ava2000", ("ava2000", "ava1000")),
        ("camera.model=nowhere.toml", ("nowhere.toml",)),
        ("camera.width=640", ("camera", "width and height")),
        ("task.start_deg=[1, 2]", ("task.start_deg", "7 joints")),
        ("task.start_deg=[180, 0, 0, 0, 0, 0, 0]", ("task.start_deg[0]", "180", "A1", "-170 to 170")),
        ("task.place_deg=[0, 0, 0, 121, 0, 0, 0]", ("task.place_deg[3]", "121", "A4")),
        ("part.x_m=1.5", ("out of reach",)),
        ("pose.position_mm=-1", ("pose.position_mm", "-1")),
    ],
)
def test_overrides_that_make_no_sense(refused, override, expected):
    message = plan(refused, "--set", override)
    for words in expected:
        assert words in message


def test_out_of_reach_says_how_far(refused):
    message = plan(refused, "--set", "part.x_m=1.5")
    assert " mm" in message or " m " in message
    assert any(character.isdigit() for character in message)


# --- model files -----------------------------------------------------------------------------------------------------


@pytest.fixture
def models(tmp_path):
    """Copies of the model folders, to be spoiled; returns their TOML files."""
    sources = {
        "robot": load_robot("iiwa14").mjcf_path,
        "gripper": load_gripper("sdh2").mjcf_path,
        "object": load_object("casting").mesh_path,
    }
    for kind, path in sources.items():
        shutil.copytree(path.parent, tmp_path / kind)
    return {kind: tmp_path / kind / "model.toml" for kind in sources}


def spoil(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, f"{old!r} is not in {path}"
    path.write_text(text.replace(old, new, 1))


def line_of(path: Path, key: str) -> str:
    return next(line for line in path.read_text().splitlines() if line.startswith(key))


@pytest.mark.parametrize(
    ("kind", "key", "replacement", "expected"),
    [
        ("object", "mass", "mass = -0.7", ("mass", "-0.7", "greater than 0")),
        ("object", "mass", "mass = nan", ("mass", "finite")),
        ("object", "mass", "mas = 0.7", ("`mas`", "did you mean `mass`")),
        ("object", "mesh", 'mesh = "none.stl"', ("mesh", "none.stl", "exists")),
        ("robot", "torque_nm", "torque_nm = [320.0, 320.0, 176.0, 176.0, 110.0, 40.0, -40.0]", ("torque_nm[6]", "-40")),
        ("robot", "velocity_deg_per_s", "velocity_deg_per_s = [85.0, 85.0]", ("velocity_deg_per_s", "7", "joint")),
        ("gripper", "pad_radius", "pad_radius = 0.0", ("pad_radius", "greater than 0")),
    ],
)
def test_model_files_with_wrong_values(refused, models, kind, key, replacement, expected):
    spoil(models[kind], line_of(models[kind], key), replacement)
    message = plan(refused, "--set", f"task.{kind}={models[kind]}")
    for words in (models[kind].name, *expected):
        assert words in message


def test_limits_the_wrong_way_round(refused, models):
    lower, upper = (line_of(models["robot"], f"position_{side}_deg") for side in ("lower", "upper"))
    spoil(models["robot"], lower, upper.replace("upper", "lower", 1))
    message = plan(refused, "--set", f"task.robot={models['robot']}")
    assert "limits.position_lower_deg[0]" in message
    assert "less than the upper limit" in message


def test_a_mesh_that_is_not_closed(refused, models):
    import trimesh

    mesh = trimesh.load_mesh(models["object"].parent / "casting.stl")
    mesh.update_faces([i > 0 for i in range(len(mesh.faces))])
    mesh.export(models["object"].parent / "casting.stl")
    assert "closed mesh" in plan(refused, "--set", f"task.object={models['object']}")


def test_a_grasp_wider_than_the_hand_opens(refused, models):
    text = models["object"].read_text()
    models["object"].write_text(text.replace("width = 0.034", "width = 0.2"))
    message = plan(refused, "--set", f"task.object={models['object']}")
    assert "opens 94.0 mm" in message
    assert "200.0 mm wide" in message


def test_a_part_too_heavy_to_hold(refused, models):
    spoil(models["object"], line_of(models["object"], "mass"), "mass = 3.0")
    message = plan(refused, "--set", f"task.object={models['object']}")
    assert "29.4 N" in message
    assert "safety factor" in message


# --- output ----------------------------------------------------------------------------------------------------------


def test_an_output_folder_below_a_file(refused, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refused("run", SCENARIO, "--out", tmp_path / "file" / "out")


def test_an_output_file_in_a_folder_that_does_not_exist(refused):
    assert "cannot be written" in refused("plan", SCENARIO, "--out", "nowhere/plan.json")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_output_folder_without_permission(refused, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "cannot be written" in refused("run", SCENARIO, "--out", tmp_path / "locked" / "out")


def test_a_refused_run_leaves_no_folder(refused, tmp_path):
    refused("run", SCENARIO, "--out", tmp_path / "out", "--set", "part.x_m=1.5")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments", [["study", "s.toml", "--trials", "0", "--out", "x"], ["fly"], ["run"]])
def test_wrong_usage_exits_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == BAD_INPUT
    assert "usage:" in capsys.readouterr().err


def test_check_names_every_bad_file_and_passes_the_good_ones(models, capsys):
    spoil(models["object"], line_of(models["object"], "mass"), "mass = 0.0")
    status = main(["check", str(models["object"]), str(models["robot"]), str(SCENARIO)])
    captured = capsys.readouterr()
    assert status == BAD_INPUT
    assert "mass" in captured.err
    assert "robot iiwa14" in captured.out
    assert "scenario 'static_sdh2'" in captured.out
