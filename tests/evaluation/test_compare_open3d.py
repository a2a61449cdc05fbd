"""The comparison's table: medians over repeats, n/a for what does not exist."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.accuracy import compare_open3d as compare
from benchmarks.shared.machine import describe_machine


def test_the_table_shows_units_and_missing_figures() -> None:
    figures = {"ate_rmse_cm": 2.3456, "track_ms": None, "peak_memory_mb": 295.4}
    table = compare.comparison_table({"ours": figures})
    assert table.cell("ours", "ATE RMSE cm (SE(3))") == "2.35"
    assert table.cell("ours", "track ms") == "n/a"
    assert table.cell("ours", "peak MB") == "295"


def test_repeats_are_reduced_to_medians_of_what_exists() -> None:
    runs = [{"ate_rmse_cm": value, "ray_cast_ms": None} for value in (1.0, 9.0, 2.0)]
    figures = compare.median_figures(runs)
    assert figures["ate_rmse_cm"] == 2.0
    assert figures["ray_cast_ms"] is None


def test_our_row_is_read_from_the_run_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], timeout_s: float, variables: dict[str, str]) -> None:
        commands.append(command)
        assert variables == {"SEMSPLAT_ISA": "avx2"}
        out = Path(command[command.index("--out") + 1])
        out.mkdir()
        times = {"tracking_ms_per_frame": 30.0, "total_ms_per_frame": 80.0}
        metrics = {"trajectory": {"ate_rmse_cm": 1.5}, "time": times}
        (out / "metrics.json").write_text(json.dumps(metrics))

    monkeypatch.setattr(compare, "_run", run)
    options = ["--dataset.kind", "tum", "--image-size", "320", "240"]
    monkeypatch.setattr(compare, "sequence_arguments", lambda _: options)
    arguments = compare.Arguments("fr1_rpy", ours="--tracking.iterations 3")
    figures = compare.our_figures("semsplat-avx2", arguments, tmp_path, 2)
    assert (figures["ate_rmse_cm"], figures["frame_ms"]) == (1.5, 80.0)
    assert figures["peak_memory_mb"] is None
    text = " ".join(commands[0])
    assert "--seed 2" in text
    assert "--image-size 320 240" in text
    assert text.endswith("--tracking.iterations 3")


def test_a_child_that_hangs_or_fails_is_one_line() -> None:
    import sys

    with pytest.raises(compare.RowError, match="stopped after"):
        compare._run([sys.executable, "-c", "import time; time.sleep(60)"], 0.2)
    with pytest.raises(compare.RowError, match="exit code 3: last words"):
        compare._run(
            [sys.executable, "-c", "import sys; print('last words', file=sys.stderr); sys.exit(3)"],
            60.0,
        )


def test_the_machine_is_described_in_one_line() -> None:
    line = describe_machine()
    assert "\n" not in line
    assert "cores" in line
    assert "torch" in line


def test_times_are_judged_relative_to_dense_slam() -> None:
    rows: dict[str, compare.Figures] = {
        compare.TITLES["semsplat-avx2"]: {"online_ms": 60.0, "frame_ms": 150.0},
        compare.TITLES["dense-slam"]: {"frame_ms": 30.0},
    }
    online, everything = compare.targets(rows, "office0")
    assert (online.value, online.met) == (2.0, True)
    assert (everything.value, everything.met) == (5.0, False)
    assert compare.targets(rows, "room") == []
    del rows[compare.TITLES["dense-slam"]]
    assert compare.targets(rows, "office0") == []
