"""The comparison with Open3D: figures of both, n/a for what does not exist."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks.accuracy import compare_open3d as compare
from benchmarks.shared.machine import describe_machine


def test_missing_figures_read_na() -> None:
    runs = [{"ATE RMSE cm (SE(3))": value, "track ms": None} for value in (1.0, 9.0, 2.35)]
    table = compare.table({"ours": runs})
    assert table.cell("ours", "ATE RMSE cm (SE(3))") == "2.35"
    assert table.cell("ours", "track ms") == table.cell("ours", "peak MB") == "n/a"


def test_our_row_is_read_from_the_run_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], variables: dict[str, str]) -> None:
        commands.append(command)
        assert variables == {"SEMSPLAT_ISA": "avx2"}
        out = Path(command[command.index("--out") + 1])
        out.mkdir()
        times = {"tracking_ms_per_frame": 30.0, "total_ms_per_frame": 80.04}
        metrics = {"trajectory": {"ate_rmse_cm": 1.5}, "time": times}
        (out / "metrics.json").write_text(json.dumps(metrics))

    monkeypatch.setattr(compare, "run_child", run)
    options = ["--dataset.kind", "tum", "--image-size", "320", "240"]
    monkeypatch.setattr(compare, "sequence_arguments", lambda _: options)
    job = {"sequence": "fr1_rpy", "method": "semsplat-avx2", "max_frames": 9}
    figures = compare.measure(job, 2)
    assert (figures["ATE RMSE cm (SE(3))"], figures["whole frame ms"]) == (1.5, 80.0)
    assert figures["peak MB"] is None
    text = " ".join(commands[0])
    assert "--seed 2" in text and "--image-size 320 240" in text
    assert text.endswith("--max-frames 9")


def test_a_child_that_hangs_or_fails_is_one_line() -> None:
    with pytest.raises(SystemExit, match="stopped after"):
        compare.run_child([sys.executable, "-c", "import time; time.sleep(60)"], timeout_s=0.2)
    failing = "import sys; print('last words', file=sys.stderr); sys.exit(3)"
    with pytest.raises(SystemExit, match="exit code 3: last words"):
        compare.run_child([sys.executable, "-c", failing])


def test_the_machine_is_described_in_one_line() -> None:
    line = describe_machine()
    assert "\n" not in line
    assert "cores" in line
    assert "torch" in line


def test_times_are_judged_relative_to_dense_slam() -> None:
    rows = {
        compare.TITLES["semsplat-avx2"]: [{"online ms": 60.0, "whole frame ms": 150.0}],
        compare.TITLES["dense-slam"]: [{"whole frame ms": 30.0}],
    }
    online, everything = compare.targets(rows, "office0")
    assert (online.value, online.met) == (2.0, True)
    assert (everything.value, everything.met) == (5.0, False)
    assert compare.targets(rows, "room") == []
    del rows[compare.TITLES["dense-slam"]]
    assert compare.targets(rows, "office0") == []
