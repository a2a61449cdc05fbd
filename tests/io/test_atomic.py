"""Atomic replacement of files."""

import os
import resource
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import RunFolderError
from toolkit.io.atomic import replacing, write_bytes, write_text
from toolkit.io.meshes import TriangleMesh, write_mesh, write_points


def test_failed_write_preserves_the_old_file_and_removes_the_temporary_one(tmp_path):
    target = tmp_path / "map.ply"
    write_bytes(target, b"old")

    def interrupted():
        with replacing(target) as temporary:
            temporary.write_bytes(b"half")
            raise KeyError("killed")

    with pytest.raises(KeyError):
        interrupted()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("name", "written"),
    [
        (os.fsencode("größe").decode("ascii", "surrogateescape"), "größe"),  # in an ASCII locale
        (b"gr\xf6\xdfe".decode("utf-8", "surrogateescape"), "gr\\xf6\\xdfe"),
        ("ソファ", "ソファ"),
    ],
)
def test_texts_with_names_that_the_locale_cannot_decode_are_utf8(tmp_path, name, written):
    write_text(tmp_path / "page.html", name)
    assert (tmp_path / "page.html").read_bytes() == written.encode()


def test_finished_write_replaces_the_file_with_default_permissions(tmp_path):
    target = tmp_path / "map.ply"
    with replacing(target) as temporary:
        assert temporary.suffix == ".ply"
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) & stat.S_IRUSR
    assert list(tmp_path.iterdir()) == [target]


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Writing fails as on a full disk: up to here, files are written."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


def silently_truncated(path: Path) -> None:
    with path.open("wb", buffering=0) as file:
        file.write(bytes(8000))  # only a part is written, which libraries do not check


def reported_by_a_library(path: Path) -> None:
    silently_truncated(path)
    raise KeyError("IoError: Failed to call write")


@pytest.mark.parametrize("write", [silently_truncated, reported_by_a_library])
def test_truncated_files_never_replace_old_ones(tmp_path, write):
    target = tmp_path / "map.usdz"
    write_bytes(target, b"old")
    with (
        files_of_at_most(4096),
        pytest.raises(RunFolderError, match=f"cannot write {target}"),
        replacing(target) as temporary,
    ):
        write(temporary)
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_meshes_and_points_on_a_full_disk_are_errors(tmp_path, capfd):
    """Open3D reports success, and prints a line for each number that it cannot write."""
    points_m = np.zeros((500, 3), np.float32)
    mesh = TriangleMesh(points_m, points_m, np.zeros((500, 3), np.int32))
    for name, write in (
        ("mesh.ply", lambda path: write_mesh(path, mesh)),
        ("points.ply", lambda path: write_points(path, points_m, points_m)),
        ("points.pcd", lambda path: write_points(path, points_m, points_m)),
    ):
        with files_of_at_most(4096), pytest.raises(RunFolderError, match=name):
            write(tmp_path / name)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")
