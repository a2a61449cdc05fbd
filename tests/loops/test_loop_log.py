"""loops.jsonl: appended, read back, cut back."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.errors import FormatError, RunFolderError
from toolkit.loops.candidates import LoopCandidate
from toolkit.loops.log import LoopLog, read_loop_log

CANDIDATE = LoopCandidate(120, 15, 3, 0, 0.19, 0.98195, None, "number 1 of 2 by landmarks", True)


def test_records_come_back_in_order(tmp_path):
    path = tmp_path / "loops.jsonl"
    log = LoopLog(path)
    log.write(CANDIDATE.record())
    log.write(CANDIDATE.record() | {"verified": False, "fitness": 0.12})
    first, second = read_loop_log(path)
    assert LoopCandidate(**first) == CANDIDATE
    assert second["fitness"] == 0.12
    assert path.read_text().count("\n") == 2


def test_each_line_is_in_the_file_once_written(tmp_path):
    path = tmp_path / "loops.jsonl"
    log = LoopLog(path)
    for count in range(1, 4):
        log.write({"query": count})
        assert len(path.read_bytes()) == log.size_bytes
        assert json.loads(path.read_text().splitlines()[-1]) == {"query": count}


def test_a_resumed_log_is_cut_back_and_goes_on_with_the_same_bytes(tmp_path):
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
    log = LoopLog(resumed, keep_bytes=checkpoint)
    for line in lines[3:]:
        log.write(line)
    assert resumed.read_bytes() == whole.read_bytes()


def test_a_torn_last_line_is_left_out(tmp_path, caplog):
    path = tmp_path / "loops.jsonl"
    LoopLog(path).write({"query": 1})
    with path.open("ab") as stream:
        stream.write(b'{"query": 2, "ma')
    assert read_loop_log(path) == [{"query": 1}]
    assert "not whole" in caplog.text


def test_a_file_shorter_than_its_checkpoint_is_refused(tmp_path):
    path = tmp_path / "loops.jsonl"
    LoopLog(path).write({"query": 1})
    before = path.read_bytes()
    with pytest.raises(RunFolderError, match="its checkpoint says 999"):
        LoopLog(path, keep_bytes=999)
    assert path.read_bytes() == before


@pytest.mark.parametrize("content", [b"{broken\n", b"[1, 2]\n", b"\xff\n"])
def test_a_damaged_line_is_named(tmp_path, content):
    path = tmp_path / "loops.jsonl"
    path.write_bytes(b'{"query": 1}\n' + content)
    with pytest.raises(FormatError, match=r"loops\.jsonl:2"):
        read_loop_log(path)


def test_a_missing_folder_or_file_is_told(tmp_path):
    with pytest.raises(RunFolderError, match="cannot write"):
        LoopLog(tmp_path / "none" / "loops.jsonl")
    with pytest.raises(FormatError, match="cannot read"):
        read_loop_log(tmp_path / "loops.jsonl")


def test_what_json_cannot_hold_is_refused_and_leaves_no_trace(tmp_path):
    log = LoopLog(tmp_path / "loops.jsonl")
    with pytest.raises(ValueError, match="JSON"):
        log.write({"distance": float("nan")})
    with pytest.raises(TypeError):
        log.write({"query": np.int64(3)})
    assert log.size_bytes == 0
    assert read_loop_log(tmp_path / "loops.jsonl") == []
