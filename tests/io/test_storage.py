"""Files and array trees in local folders and in shared storage."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from toolkit.base.errors import DependencyError, FormatError, RunFolderError
from toolkit.io import storage


@pytest.fixture(params=["local", "memory"])
def place(request, tmp_path) -> str:
    if request.param == "local":
        return str(tmp_path / "store")
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    return f"memory://{tmp_path.name}/store"


def test_what_was_written_is_read(place, tmp_path):
    assert storage.names_in(place) == []
    storage.write_tree(storage.join(place, "tree"), {"a": np.arange(3.0)}, {"n": 1})
    storage.write_bytes(storage.join(place, "b.txt"), b"text")
    (tmp_path / "big").write_bytes(b"file")
    storage.upload(tmp_path / "big", storage.join(place, "folder", "big"))
    assert storage.names_in(place) == ["b.txt", "folder", "tree"]
    tree = storage.read_tree(storage.join(place, "tree"))
    assert tree.metadata == {"n": 1} and np.array_equal(tree.arrays["a"], np.arange(3.0))
    assert storage.read_bytes(storage.join(place, "folder", "big")) == b"file"
    storage.remove_folder(storage.join(place, "tree"))
    assert storage.names_in(place) == ["b.txt", "folder"]


def test_a_file_of_another_file_system_is_copied(tmp_path):
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("there is no second file system")
    with TemporaryDirectory(dir=memory) as folder:
        local = Path(folder) / "map.ply"
        local.write_bytes(b"splats")
        storage.upload(local, str(tmp_path / "run" / "map.ply"))
        assert local.read_bytes() == b"splats"
    assert (tmp_path / "run" / "map.ply").read_bytes() == b"splats"


def test_missing_and_damaged_content_is_reported(place):
    with pytest.raises(RunFolderError, match=r"cannot read .*nothing"):
        storage.read_bytes(storage.join(place, "nothing"))
    with pytest.raises(RunFolderError, match="cannot read"):
        storage.read_tree(storage.join(place, "nothing"))
    storage.write_tree(storage.join(place, "tree"), {"a": np.arange(3.0)}, {})
    storage.write_bytes(storage.join(place, "tree", "arrays.npz"), b"PK")
    with pytest.raises(FormatError, match="damaged"):
        storage.read_tree(storage.join(place, "tree"))


def test_unknown_storage_is_reported(monkeypatch):
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    with pytest.raises(RunFolderError, match="s3://"):
        storage.read_bytes("nowhere://bucket/file")
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(DependencyError, match=r"semsplat\[cluster\]"):
        storage.read_bytes("memory://bucket/file")
