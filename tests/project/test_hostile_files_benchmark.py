"""How `benchmarks.inputs.hostile_files` makes files, and judges what readers do with them."""

from __future__ import annotations

import contextlib
import mmap
import os
import random
import signal
import time
from pathlib import Path

import pytest

from benchmarks.inputs import hostile_limits
from benchmarks.inputs.hostile_attempts import crafted, mutated
from benchmarks.inputs.hostile_files import by_cause, counted
from benchmarks.inputs.hostile_limits import Limited, limited, message_fault
from benchmarks.inputs.hostile_samples import SAMPLES
from toolkit.base.errors import FormatError, ToolkitError

_QUICK = ("class lists", "settings", "COCO", "masks", "embeddings", "map.splat")
_SLOW = ("300,000 keys", "many lines", "100,000 times")


def _written(name: str, folder: Path) -> Path:
    SAMPLES[name].write(folder)
    return folder


@pytest.mark.parametrize("name", _QUICK)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path):
    """In this process; pipes are waited for only by readers that the program would end."""
    base = _written(name, tmp_path)
    attempts = [
        attempt
        for attempt in crafted(base, ("*",), random.Random(0))
        if not attempt.name.endswith(_SLOW)
    ]
    attempts = attempts[:8] + mutated(base, ("*",), random.Random(0), 4)
    for attempt in attempts:
        path = base / attempt.file
        valid = path.read_bytes()
        attempt.change(path)
        with contextlib.suppress(ToolkitError):  # any other error fails
            SAMPLES[name].read(base)
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink(missing_ok=True)
        path.write_bytes(valid)


def test_the_same_seed_makes_the_same_files(tmp_path: Path):
    base = _written("class lists", tmp_path)
    names = [[a.name for a in crafted(base, ("*",), random.Random(3))] for _ in range(2)]
    assert names[0] == names[1]
    first, second = (mutated(base, ("*",), random.Random(3), 5) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        contents = []
        for attempt in (a, b):
            _written("class lists", tmp_path)
            attempt.change(base / attempt.file)
            contents.append((base / attempt.file).read_bytes())
        assert contents[0] == contents[1]


def _refuse() -> None:
    raise FormatError("a.txt is damaged; write it again")


def _raise() -> None:
    raise OverflowError("too large")


def _use_memory() -> None:
    # Not from the heap, which may have as much unused.
    memory = mmap.mmap(-1, 2**27)
    for page in range(0, len(memory), mmap.PAGESIZE):
        memory[page] = 1


def _use_addresses() -> None:
    bytearray(2**33)


def _end() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def test_what_a_reader_does_is_told_apart(monkeypatch):
    monkeypatch.setattr(hostile_limits, "MAX_BYTES", 2**26)
    assert limited(lambda: None).fault == limited(lambda: None).message == ""
    assert limited(_refuse).message == "a.txt is damaged; write it again"
    assert limited(_raise).fault.startswith("OverflowError in test_hostile")
    assert limited(_use_memory).fault == limited(_use_addresses).fault == "more than 2 GB"
    assert limited(_end).fault == "signal SIGSEGV"
    assert isinstance(limited(_refuse), Limited)
    monkeypatch.setattr(hostile_limits, "MAX_S", 0.3)
    assert limited(lambda: time.sleep(5)).fault == "more than 0 s"


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("a.txt is damaged; write it again", ""),
        ("a.txt is damaged\nin two lines", "a message of several lines"),
        ("a.txt has \x1b[31m", "control characters in a message"),
        ("a.txt " + "9" * 1000, "a long message"),
        ("something is damaged", "a message that does not name the file"),
    ],
)
def test_messages_are_judged(message: str, fault: str):
    assert message_fault(message, ["a.txt"]) == fault


def test_the_table_counts_what_passed():
    failure = {"sample": "folder", "attempt": "x", "fault": "a hang"}
    run = {"attempts": 9, "failures": [failure, failure], "longest_s": 25.0, "largest_mb": 3}
    good = {"attempts": 9, "failures": [], "longest_s": 0.4, "largest_mb": 2}
    table = counted({"recordings: folder": [run], "splats": [good]})
    assert table.cell("all", "attempts") == "18"
    assert table.cell("all", "failed") == "2"
    assert table.cell("splats", "passed") == "9"
    assert by_cause({"recordings: folder": [run]}).cell("a hang", "failures") == "2"
    assert by_cause({"splats": [good]}).note == "None."
