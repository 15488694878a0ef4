"""Records survive the disk exactly, and nothing else is taken for one."""

import json

import numpy as np
import pytest

from dyngrasp.closed_loop.record import ARRAY_NAMES, EpisodeRecord
from dyngrasp.errors import InputFileError


def test_comes_back_exactly(delivered, tmp_path):
    path = tmp_path / "episode"
    delivered.save(path)
    loaded = EpisodeRecord.load(path)
    assert (loaded.arm_joints, loaded.gripper_joints) == (delivered.arm_joints, delivered.gripper_joints)
    assert loaded.meta == delivered.meta
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(delivered, name), err_msg=name)
        assert getattr(loaded, name).dtype == getattr(delivered, name).dtype


def test_is_read_only(delivered):
    with pytest.raises(ValueError, match="read-only"):
        delivered.arm_measured[0, 0] = 1.0


def test_refuses_other_files(delivered, tmp_path):
    missing = tmp_path / "missing.npz"
    text = tmp_path / "text.npz"
    text.write_text("not an archive", encoding="utf-8")
    stranger = tmp_path / "stranger.npz"
    np.savez(stranger, t=np.zeros(3))
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, header=np.array([{"format": "dyngrasp.record"}], dtype=object))
    array = tmp_path / "array.npy"
    np.save(array, np.zeros(3))
    for path in (missing, text, stranger, pickled, array):
        with pytest.raises(InputFileError, match=path.name):
            EpisodeRecord.load(path)


def test_names_a_missing_array(delivered, tmp_path):
    path = tmp_path / "cut.npz"
    delivered.save(path)
    with np.load(path) as archive:
        kept = {name: archive[name] for name in archive.files if name != "pad_force"}
    np.savez(path, **kept)
    with pytest.raises(InputFileError, match="pad_force"):
        EpisodeRecord.load(path)


def test_names_a_missing_entry_of_the_header(delivered, tmp_path):
    path = tmp_path / "cut.npz"
    delivered.save(path)
    with np.load(path) as archive:
        entries = dict(archive)
    header = json.loads(str(entries["header"]))
    del header["arm_joints"]
    entries["header"] = np.array(json.dumps(header))
    np.savez(path, **entries)  # pyright: ignore[reportArgumentType]  # none of them is called allow_pickle
    with pytest.raises(InputFileError, match="arm_joints"):
        EpisodeRecord.load(path)


def test_finds_samples_by_time(delivered):
    k = delivered.index_at(1.0)
    assert delivered.t[k - 1] < 1.0 <= delivered.t[k] + 1e-9
    assert delivered.index_at(1e9) == len(delivered) - 1
