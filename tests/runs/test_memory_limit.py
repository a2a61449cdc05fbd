"""Runs that have nearly used up their memory: a checkpoint, one line, and the same result later."""

from __future__ import annotations

import pytest

from toolkit.runs import memory_limit
from toolkit.runs.memory_limit import MemoryLimit
from toolkit.tools.cli.main import main


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Writes what the system says about memory."""

    def write(membership, limits):
        (tmp_path / "meminfo").write_text("MemTotal: 1000000 kB\nMemFree: 1 kB\n")
        (tmp_path / "membership").write_text(membership)
        for place, value in limits.items():
            file = tmp_path / "groups" / place
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{value}\n")
        monkeypatch.setattr(memory_limit, "_MEMINFO", tmp_path / "meminfo")
        monkeypatch.setattr(memory_limit, "_MEMBERSHIP", tmp_path / "membership")
        monkeypatch.setattr(memory_limit, "_CGROUPS", tmp_path / "groups")
        return MemoryLimit().limit_mb

    return write


@pytest.mark.parametrize(
    ("membership", "limits", "limit_mb"),
    [
        ("0::/\n", {}, 1024.0),
        ("0::/a/b\n", {"a/b/memory.max": "max"}, 1024.0),
        ("0::/a/b\n", {"a/b/memory.max": "max", "a/memory.max": 7_000_000}, 7.0),
        ("4:cpu,memory:/c\n", {"memory/c/memory.limit_in_bytes": 9_000_000}, 9.0),
        ("4:memory:/\n", {"memory/memory.limit_in_bytes": 2**63 - 4096}, 1024.0),
        ("4:cpu:/c\n", {"memory/c/memory.limit_in_bytes": 9_000_000}, 1024.0),
    ],
)
def test_the_smallest_limit_counts(machine, membership, limits, limit_mb):
    assert machine(membership, limits) == limit_mb


def test_without_any_limit_none_is_reached(tmp_path, monkeypatch):
    for name in ("_MEMINFO", "_MEMBERSHIP", "_CGROUPS"):
        monkeypatch.setattr(memory_limit, name, tmp_path / "missing")
    assert MemoryLimit().limit_mb is None and not MemoryLimit().reached()


def test_a_run_ends_with_a_checkpoint_and_is_resumed(
    tiny_recording, tiny_run, tmp_path, monkeypatch, capsys
):
    words = ["run", "--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    words += ["--out", str(tmp_path / "run")]
    with monkeypatch.context() as patch:
        patch.setattr(memory_limit, "_limits_mb", lambda: [50.0])
        assert main(words) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert "of the 50 MB of memory" in line and f"resume {tmp_path / 'run'}" in line
    assert list((tmp_path / "run" / "checkpoint").iterdir())
    assert main([*words, "--resume"]) == 0
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "run" / name).read_bytes() == (tiny_run / name).read_bytes(), name
