"""The flat dictionary of a run's figures, and the recorder that times it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.stages import Column
from toolkit.runs.evaluation.frame_costs import peak_memory_mb
from toolkit.runs.evaluation.metrics import (
    Metrics,
    RunCosts,
    ViewQuality,
    ate_frames,
    ate_warnings,
    cost_metrics,
    depth_metrics,
    flattened,
    image_metrics,
    read_metrics,
    trajectory_metrics,
    view_quality,
    write_metrics,
)
from toolkit.runs.evaluation.timing import StageRecorder

COSTS = RunCosts(
    frames=10,
    columns_ms={Column.TRACKING: 250.0, Column.MAPPING: 90.0},
    refinement_ms=None,
    online_ms=400.0,
    total_ms=480.0,
    peak_memory_mb=321.0,
    map_mb=0.1,
)


def straight_path(step_m: float, turn_deg: float = 0.0) -> Trajectory:
    step = se3.exp(np.array([step_m, 0, 0, 0, 0, np.radians(turn_deg)]))
    poses = [np.linalg.matrix_power(step, i) for i in range(20)]
    return Trajectory(np.arange(20) / 10.0, np.stack(poses))


def view(psnr: float, ms_ssim: float | None = None, depth_l1_m: float | None = 0.01) -> ViewQuality:
    return ViewQuality(psnr, 0.9, ms_ssim, None, depth_l1_m, 0.5)


def test_trajectory_figures_are_in_centimetres_and_degrees() -> None:
    metrics = trajectory_metrics(straight_path(0.11, 2.0), straight_path(0.10, 1.0))
    assert metrics["rpe_rotation_deg"] == pytest.approx(1.0)
    assert metrics["rpe_translation_cm"] == pytest.approx(1.0, abs=0.01)
    assert metrics["alignment"] == "se3"
    assert metrics["ate_pairs"] == 20


def test_drift_of_a_monocular_path_is_measured_at_its_fitted_scale() -> None:
    metrics = trajectory_metrics(straight_path(0.05), straight_path(0.10), "sim3")
    assert metrics["scale"] == pytest.approx(2.0)
    assert metrics["ate_rmse_cm"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["rpe_translation_cm"] == pytest.approx(0.0, abs=1e-9)


def test_an_error_of_few_frames_says_so() -> None:
    path = straight_path(0.1)
    few = Trajectory(path.timestamps_s[:3], path.T_world_camera[:3])

    def of(pairs: Trajectory, frames: int) -> Metrics:
        return {"trajectory": trajectory_metrics(pairs, path), "frames": {"total": frames}}

    (line,) = ate_warnings(of(few, 20))
    assert "ATE 0.00 cm" in line and "over 3 of 20 frames" in line
    assert ate_warnings(of(few, 6)) == []
    assert ate_frames(flattened(of(few, 6))) == "over 3 of 6 frames"
    assert ate_frames(flattened(of(path, 20))) == ""
    assert ate_warnings({"trajectory": trajectory_metrics(few, None), "frames": {"total": 9}}) == []


def test_without_a_truth_errors_are_null_under_the_same_keys() -> None:
    with_truth = trajectory_metrics(straight_path(0.1), straight_path(0.1))
    without = trajectory_metrics(straight_path(0.1), None)
    assert set(without) == set(with_truth)
    assert without["ate_rmse_cm"] is None
    assert without["rpe_rotation_deg"] is None


def test_image_figures_are_means_over_the_views_that_have_them() -> None:
    views = [view(30.0, 0.8), view(40.0), view(35.0, 0.9, None)]
    images, depth = image_metrics(views), depth_metrics(views)
    assert images["views"] == 3
    assert images["psnr_db"] == pytest.approx(35.0)
    assert images["ms_ssim"] == pytest.approx(0.85)
    assert images["lpips"] is None
    assert depth["l1_cm"] == pytest.approx(1.0)
    assert depth["coverage_percent"] == pytest.approx(50.0)


def test_a_view_is_scored_on_colour_and_depth() -> None:
    rgb = np.full((20, 24, 3), 0.5, np.float32)
    depth_m = np.full((20, 24), 2.0, np.float32)
    quality = view_quality((rgb + 0.1, depth_m * 1.01), (rgb, depth_m))
    assert quality.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert quality.depth_l1_m == pytest.approx(0.02, abs=1e-5)
    assert quality.ms_ssim is None


def test_ignored_pixels_are_not_scored() -> None:
    rgb, depth_m = np.full((20, 24, 3), 0.5, np.float32), np.full((20, 24), 2.0, np.float32)
    ignored = np.zeros((20, 24), bool)
    ignored[15:] = True
    depth_m[ignored] = 0.0
    wrong = np.where(ignored[..., None], 0.0, rgb + 0.1).astype(np.float32)
    quality = view_quality((wrong, depth_m), (rgb, depth_m), ignored=ignored)
    assert quality.psnr_db == pytest.approx(20.0, abs=1e-3)
    assert quality.psnr_measured_db == pytest.approx(20.0, abs=1e-3)
    assert quality.psnr_per_channel_db > 20.0
    assert quality.psnr_inferred_db is None


def test_times_are_per_frame_of_the_whole_run() -> None:
    metrics = cost_metrics(COSTS)["time"]
    assert metrics["tracking_ms_per_frame"] == 25.0
    assert metrics["mapping_ms_per_frame"] == 9.0
    assert metrics["other_ms_per_frame"] == 6.0
    assert metrics["refinement_ms_per_frame"] is None
    assert metrics["total_ms_per_frame"] == 1.2 * metrics["online_ms_per_frame"]


def test_the_file_is_stable_and_turns_missing_numbers_into_null(tmp_path: Path) -> None:
    path = straight_path(0.1)
    metrics = {
        "trajectory": trajectory_metrics(path, path) | {"strange": float("nan")},
        "images": {"unseen": image_metrics([])},
        **cost_metrics(COSTS),
    }
    write_metrics(tmp_path / "a.json", metrics)
    write_metrics(tmp_path / "b.json", dict(reversed(metrics.items())))
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    stored = read_metrics(tmp_path / "a.json")
    assert stored["trajectory"]["strange"] is None
    assert stored["images"]["unseen"]["psnr_db"] is None
    assert flattened(stored)["images.unseen.views"] == 0


@pytest.mark.parametrize("content", ["{", json.dumps([1, 2])])
def test_a_damaged_file_is_named_with_its_remedy(tmp_path: Path, content: str) -> None:
    (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(FormatError, match="semsplat evaluate"):
        read_metrics(tmp_path / "metrics.json")


def test_the_recorder_keeps_a_call_that_raised() -> None:
    recorder = StageRecorder()
    with pytest.raises(ZeroDivisionError), recorder.timed("division"):
        1 / 0  # noqa: B018
    assert len(recorder.durations_ms["division"]) == 1


def test_the_recorder_sums_calls_and_sorts_by_total() -> None:
    recorder = StageRecorder()
    recorder.durations_ms = {"often": [1.0, 3.0, 2.0], "long": [50.0]}
    longest, often = recorder.stage_times()
    assert (longest.stage, longest.calls, longest.total_s) == ("long", 1, 0.05)
    assert often.median_ms == 2.0
    assert recorder.total_ms("often") == 6.0
    assert recorder.total_ms("never") is None


def test_peak_memory_grows_with_what_is_held_and_does_not_fall_again() -> None:
    before = peak_memory_mb()
    block = np.ones(150_000_000, np.uint8)
    held = peak_memory_mb()
    del block
    assert before > 20.0
    # The kernel counts pages in batches, a fraction of a MB apart.
    assert peak_memory_mb() == pytest.approx(held, abs=5.0)
    assert held >= 150.0
