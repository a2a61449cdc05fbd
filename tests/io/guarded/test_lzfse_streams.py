"""Compressed depth of other people, which a few bytes could turn into gigabytes."""

from __future__ import annotations

import contextlib
import struct

import numpy as np
import pytest

from toolkit.io.guarded.content import DamagedError
from toolkit.io.guarded.lzfse_streams import decompressed

lzfse = pytest.importorskip("lzfse")

_END = b"bvx$"
_DEPTH = np.linspace(0.5, 4.0, 192 * 256, dtype=np.float32)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"a",
        bytes(5000),
        _DEPTH.tobytes(),
        np.random.default_rng(0).normal(2.0, 0.5, 720 * 960).astype(np.float32).tobytes(),
        np.tile(_DEPTH, 20).tobytes(),
    ],
    ids=["nothing", "a byte", "zeros", "a ramp", "noise", "repeated"],
)
def test_streams_are_unpacked_as_before(content):
    assert decompressed(lzfse.compress(content), lzfse) == content


def test_a_stream_that_states_too_much_is_refused():
    part = lzfse.compress(bytes(2**20)).removesuffix(_END)
    with pytest.raises(DamagedError, match="at most 64 MB"):
        decompressed(part * 65 + _END, lzfse)


@pytest.mark.parametrize("kind", [b"bvx-", b"bvxn"])
def test_a_block_that_states_gigabytes_is_refused(kind):
    block = kind + struct.pack("<II", 0xFFFFFFF0, 64) + bytes(64) + _END
    with pytest.raises(DamagedError):
        decompressed(block, lzfse)


def test_damaged_blocks_do_not_use_the_memory_of_the_machine():
    """The package itself doubles its buffer until none is left."""
    whole = lzfse.compress(_DEPTH[:768].tobytes())
    for place in range(12, 100, 4):
        content = whole[:place] + b"\xff\xff\xff\xff" + whole[place + 4 :]
        with contextlib.suppress(DamagedError):
            assert len(decompressed(content, lzfse)) < 2**20


def test_damaged_streams_are_refused_wherever_they_are_cut():
    whole = lzfse.compress(_DEPTH.tobytes())
    for end in range(0, len(whole), 397):
        with pytest.raises(DamagedError):
            decompressed(whole[:end], lzfse)
    with pytest.raises(DamagedError, match="no stream"):
        decompressed(b"bvx9" + whole[4:], lzfse)
