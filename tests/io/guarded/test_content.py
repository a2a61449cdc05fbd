"""Content that is checked before it is read."""

from __future__ import annotations

import os

import pytest

from toolkit.base.errors import ToolkitError
from toolkit.io.guarded.content import DamagedError, read_content


def test_a_large_file_that_was_never_written_is_refused(tmp_path):
    file = tmp_path / "map.splat"
    file.write_bytes(b"\x01" * 4096)
    os.truncate(file, 20 * 2**30)
    with pytest.raises(DamagedError, match="most of its 20 GB were never written"):
        read_content(file)


def test_a_small_file_with_a_hole_is_read(tmp_path):
    file = tmp_path / "zeros"
    file.touch()
    os.truncate(file, 2**20)
    assert read_content(file) == bytes(2**20)


@pytest.mark.parametrize("kind", ["pipe", "device", "large"])
def test_what_does_not_end_or_is_too_large_is_refused(tmp_path, kind):
    file = tmp_path / "file"
    if kind == "pipe":
        os.mkfifo(file)
    elif kind == "device":
        file.symlink_to("/dev/zero")
    else:
        file.write_bytes(bytes(11))
    with pytest.raises(DamagedError):
        read_content(file, 10)


def test_a_message_that_quotes_a_file_keeps_its_start_and_its_remedy():
    message = str(ToolkitError(f"a.txt, line 3: {'9' * 10_000}; correct the line"))
    assert message.startswith("a.txt, line 3: 999")
    assert message.endswith("99; correct the line")
    assert len(message) < 600
    assert str(ToolkitError("a.txt is missing")) == "a.txt is missing"
