"""Archives and arrays of other people: nothing is unpacked before it is checked."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from toolkit.io.guarded.archive import Archive
from toolkit.io.guarded.arrays import read_array, read_arrays
from toolkit.io.guarded.content import DamagedError

VALUES = np.arange(5)


def npy(array: np.ndarray = VALUES) -> bytes:
    content = io.BytesIO()
    np.lib.format.write_array(content, array)
    return content.getvalue()


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def changed(path: Path, offset_in_entry: int, value: int) -> Path:
    """Change two bytes of the first entry of the directory of an archive."""
    content = bytearray(path.read_bytes())
    entry = content.rfind(b"PK\x01\x02")
    content[entry + offset_in_entry : entry + offset_in_entry + 2] = value.to_bytes(2, "little")
    path.write_bytes(content)
    return path


def test_arrays_are_those_that_were_written(tmp_path: Path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "text": np.array("text"),
        "names": np.array(["a", "bc"]),
        "empty": np.zeros((0, 3), np.float32),
        "flags": np.array([True, False]),
    }
    np.savez_compressed(tmp_path / "a.npz", allow_pickle=False, **arrays)
    found = read_arrays(tmp_path / "a.npz")
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype and found[name].flags.writeable
    assert found["columns"].flags.f_contiguous
    assert list(read_arrays(tmp_path / "a.npz", lambda name: name == "text")) == ["text"]
    (tmp_path / "b.npy").write_bytes(npy())
    np.testing.assert_array_equal(read_array(tmp_path / "b.npy"), VALUES)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (npy()[:-3], "has 37 bytes"),
        (npy().replace(b"(5,)", b"(5e)"), "Cannot parse header"),
        (npy().replace(b"'<i8'", b"'|O8'"), "has the type object"),
        (npy().replace(b"(5,), ", b"(-5,),"), "has the type"),
        (npy().replace(b"(5,), }          ", b"(99999999999,), }"), "has 40 bytes"),
        (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 60_000, "EOF"),
        (npy()[:6] + b"\x03\x00" + npy()[8:], "version"),
        (b"PK", "EOF"),
    ],
)
def test_damaged_arrays(tmp_path: Path, content: bytes, fault: str):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(DamagedError, match=fault):
        read_array(tmp_path / "a.npy")
    path = zipped(tmp_path / "a.npz", {"a.npy": content})
    with pytest.raises(DamagedError, match=fault):
        read_arrays(path)


def test_members_that_are_not_unpacked(tmp_path: Path):
    bomb = zipped(tmp_path / "bomb.zip", {"zeros": bytes(2**25)})
    with Archive(bomb) as archive:
        with pytest.raises(DamagedError, match="would be unpacked to 32 MB"):
            archive.read("zeros")
        with pytest.raises(DamagedError, match="would be unpacked"):
            archive.check()
        with pytest.raises(DamagedError, match="'other' is missing"):
            archive.read("other")
        assert archive.size("zeros") == len(archive.read("zeros", max_ratio=2000)) == 2**25
    for method in (zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2):
        other = zipped(tmp_path / "other.zip", {"a": b"a"}, method)
        with Archive(other) as archive, pytest.raises(DamagedError, match=f"by method {method}"):
            archive.read("a")
    encrypted = changed(zipped(tmp_path / "encrypted.zip", {"a": b"a"}), 8, 1)
    with Archive(encrypted) as archive, pytest.raises(DamagedError, match="encrypted"):
        archive.read("a")


def test_damaged_archives(tmp_path: Path):
    path = tmp_path / "a.zip"
    path.write_text("no archive")
    with pytest.raises(DamagedError, match="not a zip file"):
        Archive(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a", "1")
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a", "2")
    with pytest.raises(DamagedError, match="twice"):
        Archive(path)
    content = bytearray(zipped(path, {"a": b"abcdefgh"}, zipfile.ZIP_STORED).read_bytes())
    content[content.index(b"abcd")] = 0
    path.write_bytes(content)
    with Archive(path) as archive, pytest.raises(DamagedError, match="CRC"):
        archive.read("a")


def test_arrays_that_are_too_large_together(tmp_path: Path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(2**20), b=np.zeros(2**20))
    assert len(read_arrays(tmp_path / "a.npz", max_bytes=2**25)) == 2
    with pytest.raises(DamagedError, match="unpacked"):
        read_arrays(tmp_path / "a.npz", max_bytes=3 * 2**22)
