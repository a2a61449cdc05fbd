"""Runs of `semsplat run --depth none` on known sequences, and their errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.monocular.motion_errors import motion_errors, path_m, scale_drift_percent, still_m
from benchmarks.shared.recordings import INVERTED_ROTATIONS, opened, sequence_arguments
from benchmarks.shared.runner import WORK
from benchmarks.shared.runs import finished_run
from benchmarks.shared.tables import Metrics
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import RecordedDataset
from toolkit.depth.monocular.motion import CameraMotion, estimate_motion
from toolkit.depth.monocular.sequence import MonocularSequence

OUTLIER = 0.2
DEPTH_VIEWS = 12
FILM_FPS = 30.0


def measure(job: dict[str, Any], seed: int) -> Metrics:
    """Run one sequence without depth.

    Args:
        job: `sequence`, a key of RECORDINGS or of ROOMS; `options` of the run; and `film`: whether
            it is a film without intrinsics.
        seed: of the run and of the room.
    """
    dataset = opened(job["sequence"], seed)
    source = sequence_arguments(job["sequence"], seed)
    if job["film"]:
        film = _film(f"{job['sequence']}-{seed}", dataset)
        source = ["--dataset.kind", "video", "--dataset.path", str(film)]
    with finished_run([*source, "--depth", "none", *job["options"]], seed) as (metrics, folder):
        found = folder.read_trajectory() if folder.trajectory.exists() else None
    truth = dataset.ground_truth
    assert truth is not None
    metrics |= {"still_cm": 100.0 * still_m(truth), "path_m": path_m(truth)}
    if job["film"]:
        truth = _with_film_times(truth, dataset)
    if found is not None:
        metrics |= motion_errors(found, truth)
        if job["sequence"] in INVERTED_ROTATIONS:
            metrics.pop("rotation_rms_deg", None)
        metrics["scale_drift_percent"] = scale_drift_percent(found, truth)
    if job["film"]:
        return metrics | _focal(metrics, dataset)
    motion = estimate_motion(dataset, dataset.camera)
    scale = metrics.get("trajectory.scale")
    if isinstance(scale, float):
        metrics |= _depth(dataset, motion, scale)
    return metrics


def _depth(dataset: RecordedDataset, motion: CameraMotion, scale: float) -> Metrics:
    """Density and errors of the depth of some keyframes."""
    if dataset.files(0).depth is None or not motion.views:
        return {}
    sequence = MonocularSequence(dataset, motion)
    known, measured, errors = 0, 0, []
    for number in np.unique(np.linspace(0, len(motion.views) - 1, DEPTH_VIEWS).astype(int)):
        index = motion.views[number].frame
        depth, true = scale * sequence[index].depth_m, dataset[index].depth_m
        both = (depth > 0) & (true > 0)
        known, measured = known + int(both.sum()), measured + int((true > 0).sum())
        errors.append(np.abs(depth[both] / true[both] - 1.0))
    error = np.concatenate(errors)
    return {
        "depth_density_percent": 100.0 * known / measured,
        "depth_median_error_percent": 100.0 * float(np.median(error)),
        "depth_outliers_percent": 100.0 * float((error > OUTLIER).mean()),
    }


def _film(name: str, dataset: RecordedDataset) -> Path:
    """The images as a film without intrinsics, written when it is first needed."""
    path = WORK / "films" / f"{name}.mp4"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"partial-{path.name}")
    codec = cv2.VideoWriter_fourcc(*"mp4v")
    size = dataset.camera.width, dataset.camera.height
    writer = cv2.VideoWriter(str(partial), codec, FILM_FPS, size)
    for frame in dataset:
        writer.write(np.round(255.0 * frame.rgb[..., ::-1]).astype(np.uint8))
    writer.release()
    return partial.rename(path)


def _with_film_times(truth: Trajectory, dataset: RecordedDataset) -> Trajectory:
    """The true poses at the timestamps of the film."""
    frames = np.searchsorted(dataset.timestamps_s, truth.timestamps_s)
    return Trajectory(frames / FILM_FPS, truth.T_world_camera)


def _focal(metrics: Metrics, dataset: RecordedDataset) -> Metrics:
    focal = metrics.get("monocular.focal_px")
    if not isinstance(focal, float):
        return {}
    return {"focal_error_percent": 100.0 * abs(focal / dataset.camera.focal - 1.0)}
