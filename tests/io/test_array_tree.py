"""Array trees: reproducible bytes and atomic replacement."""

import numpy as np
import pytest

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.io import arrays
from toolkit.io.arrays import (
    compress_array_tree,
    read_array_tree,
    write_array_tree,
)

VALUES = {
    "map/means": np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
    "poses": np.eye(4)[None].repeat(3, axis=0),
    "mask": np.array([True, False]),
    "empty": np.zeros((0, 7), np.int32),
    "scalar": np.float64(3.5),
}
META = {"frame": 12, "seed": 2**63, "names": ["a", "b"], "none": None}


def test_round_trip_preserves_values_types_and_shapes(tmp_path):
    write_array_tree(tmp_path / "state", VALUES, META)
    tree = read_array_tree(tmp_path / "state")
    assert tree.metadata == META
    assert set(tree.arrays) == set(VALUES)
    for name, array in VALUES.items():
        assert tree.arrays[name].dtype == np.asarray(array).dtype
        np.testing.assert_array_equal(tree.arrays[name], array)


def test_output_is_reproducible(tmp_path):
    write_array_tree(tmp_path / "a", VALUES, META)
    write_array_tree(tmp_path / "b", dict(reversed(VALUES.items())), META)
    for name in ("arrays.npz", "metadata.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_compression_changes_the_size_only(tmp_path):
    values = {**VALUES, "labels": np.zeros((200, 100), np.int16)}
    for folder in (tmp_path / "a", tmp_path / "b"):
        write_array_tree(folder, values, META)
        before = (folder / "arrays.npz").stat().st_size
        compress_array_tree(folder)
        assert (folder / "arrays.npz").stat().st_size < 0.2 * before
    tree = read_array_tree(tmp_path / "a")
    assert tree.metadata == META and list(tree.arrays) == sorted(values)
    for name, array in values.items():
        np.testing.assert_array_equal(tree.arrays[name], array)
    a, b = ((tmp_path / name / "arrays.npz").read_bytes() for name in "ab")
    assert a == b
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["arrays.npz", "metadata.json"]


def test_what_cannot_be_compressed_stays(tmp_path, monkeypatch):
    write_array_tree(tmp_path / "state", VALUES, META)

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arrays.zipfile.ZipFile, "writestr", full_disk)
    with pytest.raises(RunFolderError, match="No space left"):
        compress_array_tree(tmp_path / "state")
    assert set(read_array_tree(tmp_path / "state").arrays) == set(VALUES)
    (tmp_path / "state" / "arrays.npz").write_bytes(b"PK")
    with pytest.raises(FormatError, match="damaged"):
        compress_array_tree(tmp_path / "state")


def test_replacing_keeps_only_the_new_folder(tmp_path):
    write_array_tree(tmp_path / "state", VALUES, META)
    write_array_tree(tmp_path / "state", {"x": np.ones(2)}, {})
    assert list(read_array_tree(tmp_path / "state").arrays) == ["x"]
    assert [p.name for p in tmp_path.iterdir()] == ["state"]


def test_failed_write_preserves_the_old_folder(tmp_path, monkeypatch):
    write_array_tree(tmp_path / "state", VALUES, META)

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arrays, "_write_arrays", full_disk)
    with pytest.raises(RunFolderError, match="No space left"):
        write_array_tree(tmp_path / "state", {"x": np.ones(2)}, {})
    assert read_array_tree(tmp_path / "state").metadata == META
    assert [p.name for p in tmp_path.iterdir()] == ["state"]


@pytest.mark.parametrize("damage", ["truncated", "flipped"])
def test_damaged_files_raise(tmp_path, damage):
    write_array_tree(tmp_path / "state", VALUES, META)
    file = tmp_path / "state" / "arrays.npz"
    content = bytearray(file.read_bytes())
    if damage == "truncated":
        content = content[:-30]
    else:
        content[content.find(VALUES["map/means"].tobytes())] ^= 1
    file.write_bytes(content)
    with pytest.raises(FormatError, match="state is damaged"):
        read_array_tree(tmp_path / "state")


def test_missing_folder_and_unsupported_values_raise(tmp_path):
    with pytest.raises(RunFolderError, match="nowhere"):
        read_array_tree(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="Python objects"):
        write_array_tree(tmp_path / "state", {"x": np.array([object()])}, {})
    with pytest.raises(ValueError, match="JSON"):
        write_array_tree(tmp_path / "state", {}, {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []
