"""Atomic replacement of files."""

import stat

import pytest

from toolkit.io.atomic import replacing, write_bytes


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


def test_finished_write_replaces_the_file_with_default_permissions(tmp_path):
    target = tmp_path / "map.ply"
    with replacing(target) as temporary:
        assert temporary.suffix == ".ply"
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) & stat.S_IRUSR
    assert list(tmp_path.iterdir()) == [target]
