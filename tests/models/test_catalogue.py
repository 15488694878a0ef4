import pytest

from dyngrasp.errors import ModelFileError, UnknownName
from dyngrasp.models.catalogue import GRIPPERS, ROBOTS, check_model, load_gripper, load_robot, reach


@pytest.mark.parametrize(("load", "known"), [(load_robot, ROBOTS), (load_gripper, GRIPPERS)])
def test_names_folders_and_files_load_the_same_model(load, known):
    for name, folder in known.items():
        assert load(name).name == load(folder).name == load(str(folder / "model.toml")).name == name


@pytest.mark.parametrize("load", [load_robot, load_gripper])
def test_an_unknown_name_lists_the_valid_ones(load):
    with pytest.raises(UnknownName) as caught:
        load("nosuch")
    assert set(caught.value.known) in ({*ROBOTS}, {*GRIPPERS})
    assert caught.value.known[0] in str(caught.value)


def test_a_missing_file_is_reported_as_missing(tmp_path):
    with pytest.raises(ModelFileError, match="readable file"):
        load_robot(tmp_path / "absent" / "model.toml")
    with pytest.raises(ModelFileError, match="readable file"):
        load_robot("absent.toml")


def test_facts_of_the_models_that_come_along():
    robot = "\n".join(check_model(ROBOTS["iiwa14"]))
    assert "7 joints" in robot
    assert "29.90 kg" in robot
    assert "A4: -120 to 120 deg, 75 deg/s, 176 Nm" in robot
    gripper = "\n".join(check_model(GRIPPERS["sdh2"] / "model.toml"))
    assert "opens to 94.0 mm" in gripper
    assert "1.95 kg" in gripper


def test_reach_of_the_iiwa_is_its_stretched_length():
    # The frame of A2 lies 10 mm beside the shoulder, which adds some 0.1 mm to 946 mm.
    assert reach(load_robot("iiwa14")) == pytest.approx(0.420 + 0.400 + 0.126, abs=2e-4)


def test_a_file_of_no_known_kind_is_refused(tmp_path):
    path = tmp_path / "model.toml"
    path.write_text("kind = 'boat'\n")
    with pytest.raises(ModelFileError, match='"robot", "gripper", "object"') as caught:
        check_model(path)
    assert caught.value.key == "kind"
