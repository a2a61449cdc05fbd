"""A file is replaced as a whole or stays as it was."""

import stat

import pytest

from toolkit.io.atomic import replacing, write_bytes


def test_a_failed_write_leaves_the_old_file_and_no_rest(tmp_path):
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


def test_a_finished_write_is_in_place_and_readable_by_others(tmp_path):
    target = tmp_path / "map.ply"
    with replacing(target) as temporary:
        assert temporary.suffix == ".ply"
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"new"
    assert stat.S_IMODE(target.stat().st_mode) & stat.S_IRUSR
    assert list(tmp_path.iterdir()) == [target]
