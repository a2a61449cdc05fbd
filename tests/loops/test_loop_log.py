"""The loop log: append, read and truncate."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.slam.loops.candidates import LoopCandidate
from toolkit.slam.loops.log import LoopLog, read_loop_log

CANDIDATE = LoopCandidate(
    120, 15, 3, 0, 0.19, 0.98195, None, "rank 1 of 2 by landmarks, 1 in its submap", True
)


def test_records_are_read_in_order(tmp_path):
    path = tmp_path / "loops.jsonl"
    log = LoopLog(path)
    log.write(CANDIDATE.record())
    log.write(CANDIDATE.record() | {"verified": False, "fitness": 0.12})
    first, second = read_loop_log(path)
    assert LoopCandidate(**first) == CANDIDATE
    assert second["fitness"] == 0.12
    assert path.read_text().count("\n") == 2


def test_write_flushes_each_line(tmp_path):
    path = tmp_path / "loops.jsonl"
    log = LoopLog(path)
    for count in range(1, 4):
        log.write({"query": count})
        assert len(path.read_bytes()) == log.size_bytes
        assert json.loads(path.read_text().splitlines()[-1]) == {"query": count}


def test_resumed_log_equals_uninterrupted_log(tmp_path):
    whole, resumed = tmp_path / "whole.jsonl", tmp_path / "resumed.jsonl"
    lines = [{"query": n, "distance": n / 7.0} for n in range(6)]
    log = LoopLog(whole)
    for line in lines:
        log.write(line)
    log = LoopLog(resumed)
    for line in lines[:3]:
        log.write(line)
    checkpoint = log.size_bytes
    log.write({"query": "of a run that was killed"})
    with resumed.open("ab") as stream:
        stream.write(b'{"query": 4, "dist')
    log = LoopLog(resumed)
    log.truncate(checkpoint)
    for line in lines[3:]:
        log.write(line)
    assert resumed.read_bytes() == whole.read_bytes()


def test_incomplete_last_line_is_skipped(tmp_path, caplog):
    path = tmp_path / "loops.jsonl"
    LoopLog(path).write({"query": 1})
    with path.open("ab") as stream:
        stream.write(b'{"query": 2, "ma')
    assert read_loop_log(path) == [{"query": 1}]
    assert "incomplete last line" in caplog.text


def test_file_shorter_than_checkpoint_raises(tmp_path):
    path = tmp_path / "loops.jsonl"
    log = LoopLog(path)
    log.write({"query": 1})
    before = path.read_bytes()
    with pytest.raises(RunFolderError, match="checkpoint expects 999"):
        log.truncate(999)
    assert path.read_bytes() == before


@pytest.mark.parametrize("content", [b"{broken\n", b"[1, 2]\n", b"\xff\n"])
def test_error_names_the_invalid_line(tmp_path, content):
    path = tmp_path / "loops.jsonl"
    path.write_bytes(b'{"query": 1}\n' + content)
    with pytest.raises(FormatError, match=r"loops\.jsonl:2"):
        read_loop_log(path)


def test_missing_folder_or_file_raises(tmp_path):
    with pytest.raises(RunFolderError, match="cannot write"):
        LoopLog(tmp_path / "none" / "loops.jsonl")
    with pytest.raises(FormatError, match="cannot read"):
        read_loop_log(tmp_path / "loops.jsonl")


def test_invalid_record_raises_and_writes_nothing(tmp_path):
    log = LoopLog(tmp_path / "loops.jsonl")
    with pytest.raises(ValueError, match="JSON"):
        log.write({"distance": float("nan")})
    with pytest.raises(TypeError):
        log.write({"query": np.int64(3)})
    assert log.size_bytes == 0
    assert read_loop_log(tmp_path / "loops.jsonl") == []
