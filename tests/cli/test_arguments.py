"""Options that stand for overrides: which scenario comes out of them."""

import runpy
from pathlib import Path

import pytest

import dyngrasp
from dyngrasp.cli.arguments import argument_parser
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.models.catalogue import ASSETS

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def scenario(file, *options, command=("run",)):
    parsed = argument_parser("0").parse_args([*command, str(SCENARIOS / file), *options])
    return load_scenario(parsed.scenario, parsed.overrides)


@pytest.mark.parametrize("command", [("run",), ("study", "--trials", "1", "--out", "x")])
def test_a_camera_needs_no_table(command):
    # static_sdh2 neither knows a camera nor replans: pictures that nobody follows would be none.
    seen = scenario("static_sdh2.toml", "--pose", "camera", command=command)
    assert seen.pose.source == "camera"
    assert seen.replanner.enabled
    assert seen.camera.model == "ava1000"


def test_the_truth_has_no_errors():
    true = scenario("camera_sdh2.toml", "--pose", "truth")
    assert true.pose.source == "truth"
    assert true.pose.position_mm == true.pose.rotation_deg == 0
    assert true.replanner.enabled


def test_noise_keeps_the_errors():
    noisy = scenario("replan_20mm.toml", "--pose", "noise")
    assert (noisy.pose.source, noisy.pose.position_mm) == ("noise", 20.0)


@pytest.mark.parametrize("options", [("--pose", "camera", "--no-replan"), ("--no-replan", "--pose", "camera")])
def test_whoever_wants_no_replans_gets_none(options):
    assert not scenario("static_sdh2.toml", *options).replanner.enabled


@pytest.mark.parametrize("first", [True, False])
def test_single_keys_have_the_last_word(first):
    pose, key = ("--pose", "camera"), ("--set", "pose.source=noise")
    assert scenario("static_sdh2.toml", *((*key, *pose) if first else (*pose, *key))).pose.source == "noise"


def test_other_sources_are_refused(capsys):
    with pytest.raises(SystemExit) as exit_:
        scenario("static_sdh2.toml", "--pose", "guess")
    assert exit_.value.code == 2
    message = capsys.readouterr().err
    for words in ("guess", "camera", "noise", "truth"):
        assert words in message


class TestPathsOfModels:
    """A path in a file is relative to that file, in an override to the working directory."""

    @pytest.fixture
    def elsewhere(self, tmp_path, monkeypatch):
        folder = tmp_path / "lab"
        folder.mkdir()
        text = (ASSETS / "cameras" / "ava1000" / "model.toml").read_text().replace('"ava1000"', '"mine"')
        (folder / "camera.toml").write_text(text)
        (folder / "look.toml").write_text(
            f'extends = "{SCENARIOS / "static_sdh2.toml"}"\nname = "look"\n[camera]\nmodel = "camera.toml"\n'
        )
        monkeypatch.chdir(tmp_path)
        return folder

    def test_in_a_file(self, elsewhere):
        assert Path(load_scenario("lab/look.toml").camera.model) == Path("lab/camera.toml")
        (elsewhere / "deep").mkdir()
        (elsewhere / "deep" / "more.toml").write_text('extends = "../look.toml"\nname = "more"\n')
        assert Path(load_scenario("lab/deep/more.toml").camera.model).resolve() == elsewhere / "camera.toml"

    def test_in_an_override(self, elsewhere):
        overridden = load_scenario("lab/look.toml", ["camera.model=lab/camera.toml"])
        assert Path(overridden.camera.model) == elsewhere / "camera.toml"

    def test_names_stay(self, elsewhere):
        assert load_scenario("lab/look.toml", ["camera.model=ava1000"]).camera.model == "ava1000"


def test_the_package_runs_as_a_module(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["dyngrasp", "--version"])
    with pytest.raises(SystemExit) as left:
        runpy.run_module("dyngrasp", run_name="__main__")
    assert left.value.code == 0
    assert dyngrasp.__version__ in capsys.readouterr().out
