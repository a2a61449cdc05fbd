"""Maps of sequences with automatic white balance, with and without its estimate.

    SEMSPLAT_DATA=DATA python -m benchmarks.white_balance

Each row runs the whole system. A room is rendered with constant white balance; for other rows its
images are multiplied by smoothly changing gains of the channels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import RECORDINGS, room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Target, median_of, table_of, target_table
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.images import psnr_db
from toolkit.runs.settings import RunSettings
from toolkit.slam.result import SlamResult
from toolkit.splatting.rendering import render

COLUMNS = (
    "psnr_clean_db",
    "images.mapped.psnr_db",
    "images.mapped.psnr_one_gain_db",
    "images.mapped.psnr_per_channel_db",
    "trajectory.ate_rmse_cm",
    "largest_change_percent",
    "frames.lost",
    "ms_per_frame",
)
DESCRIPTION = """\
Runs with and without `mapping.white_balance`. The drift multiplies red by 1 + 0.2 sin and blue
by 1 - 0.2 sin, with a period of 150 frames, in a room of 300 (`semsplat make-room`, 320x240).
"clean" compares the map at the exposure of the first frame with the images without drift, at the
poses of the run. The other PSNRs compare with the images that the run was given: at the gain, bias
and white balance that the run estimated for each view (`images.mapped.psnr_db`), at its gain and
bias only (`one_gain`), and after fitting one gain per channel to the view (`per_channel`). The
largest change is that of a channel's gain between the first and any other frame.
RedKitchen and fr1/rpy are
resized to 320x240."""
_SWING, _PERIOD_FRAMES = 0.2, 150
_MAX_VIEWS = 100
CONSTANT, DRIFT = "room, constant", "room, drift"
SEQUENCES = {
    CONSTANT: "room",
    DRIFT: "room",
    "RedKitchen": "redkitchen",
    "fr1/rpy": "fr1_rpy",
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Map sequences with changing white balance."""

    max_frames: int | None = None
    """Number of frames of each sequence; all by default."""


class DriftingBalance:
    """A dataset whose white balance changes smoothly; that of the first frame is unchanged."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    @staticmethod
    def gains(index: int) -> NDArray[np.float32]:
        """Gains [3] of the channels of a frame."""
        swing = _SWING * np.sin(2.0 * np.pi * index / _PERIOD_FRAMES)
        return np.array([1.0 + swing, 1.0, 1.0 - swing], np.float32)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        frame = self._dataset[index]
        return replace(frame, rgb=(frame.rgb * self.gains(index)).clip(0.0, 1.0))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)


def main() -> None:
    """Measure every sequence with and without the estimate."""
    options = tyro.cli(Options)
    report = Report("white_balance", "White balance", DESCRIPTION, options)
    jobs = {
        f"{name}, {'with' if use else 'without'}": {
            "sequence": sequence,
            "drift": name == DRIFT,
            "use": use,
            "max_frames": options.max_frames,
        }
        for name, sequence in SEQUENCES.items()
        for use in (False, True)
    }
    rows = report.measured(jobs, measure)
    constant, drift = (
        median_of(rows)(f"{name}, with", "psnr_clean_db") for name in (CONSTANT, DRIFT)
    )
    loss = None if constant is None or drift is None else constant - drift
    target = Target("loss of the room by drift in dB", loss, at_most=1.5)
    report.write(table_of(COLUMNS, rows, "sequence"), target_table([target]))


def measure(job: dict[str, Any], seed: int) -> Metrics:
    """Run one sequence in this process."""
    clean, place = _opened(job)
    settings = validated(
        RunSettings,
        {**place, "seed": seed, "mapping": {"white_balance": job["use"]}},
    )
    dataset = DriftingBalance(clean) if job["drift"] else clean
    with finished_slam(settings, dataset) as run:
        balances = np.array([exposure.balance for exposure in run.result.exposures])
        return run.metrics | {
            "psnr_clean_db": _psnr_clean_db(run.result, clean) if _is_room(job) else None,
            "largest_change_percent": 100.0 * float(np.abs(balances / balances[0] - 1.0).max()),
            "ms_per_frame": float(np.mean(run.frames_ms)) + 1e3 * run.finish_s / len(clean),
        }


def _is_room(job: dict[str, Any]) -> bool:
    return job["sequence"] not in RECORDINGS


def _opened(job: dict[str, Any]) -> tuple[Dataset, dict[str, Any]]:
    """The dataset of a job, and its settings."""
    if _is_room(job):
        kind, path, size = "synthetic", room(job["sequence"]), None
    else:
        recording = RECORDINGS[job["sequence"]]
        kind, path, size = recording.kind, recording.path, recording.image_size
    settings: dict[str, Any] = {
        "dataset": {"kind": kind, "path": str(path)},
        "image_size": size,
        "max_frames": job["max_frames"],
    }
    return open_dataset(kind, path, size, job["max_frames"]), settings


def _psnr_clean_db(result: SlamResult, clean: Dataset) -> float:
    """Mean PSNR of the map, at the exposure of the first frame, against images without drift."""
    first = result.exposures[0]
    count = len(result.frame_indices)
    gaussians, scores = result.gaussians, []
    for position in np.linspace(0, count - 1, min(count, _MAX_VIEWS)).round().astype(int):
        frame = clean[result.frame_indices[position]]
        T_camera_map = se3.inverse(result.trajectory.T_world_camera[position])
        view = render(gaussians, frame.camera, T_camera_map)
        scores.append(psnr_db(first.undo(view.colour), frame.rgb))
    return float(np.mean(scores))


if __name__ == "__main__":
    main()
