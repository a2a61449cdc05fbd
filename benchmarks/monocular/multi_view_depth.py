"""Depth of keyframes from the keyframes around them: density, accuracy, confidence and time.

SEMSPLAT_DATA=DATA python -m benchmarks.monocular.multi_view_depth [--only NAMES]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.recordings import opened
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, table_of
from toolkit.datasets.base import RecordedDataset
from toolkit.depth.depth_priors.multi_view import EstimatedDepth, MultiViewDepth, SweptKeyframe
from toolkit.depth.monocular.motion import estimate_motion
from toolkit.splatting.alignment.levels import intensity_of

Found = TypeVar("Found")

COLUMNS = (
    *("density_percent", "median_error_percent", "outliers_percent", "within_1_sigma_percent"),
    *("within_2_sigma_percent", "within_1_sigma_unscaled_percent", "inferred_percent"),
    *("inferred_median_error_percent", "inferred_outliers_percent"),
    *("inferred_within_1_sigma_percent", "sweep_ms", "consensus_ms", "completion_ms"),
)
# The sequence of each row; frames from one keyframe to the next, or None for estimated poses.
ROWS: dict[str, tuple[str, int | None]] = {
    "office0, true poses": ("office0", 2),
    "room, true poses": ("room", 8),
    "room, sensor noise, true poses": ("room-noise", 8),
    "room, plain walls, sensor noise, true poses": ("room-plain", 6),
    "RedKitchen, true poses": ("redkitchen", 4),
    "HoloLens walk, true poses": ("hololens", 2),
    "office0, estimated poses": ("office0", None),
    "room, estimated poses": ("room", None),
    "room, sensor noise, estimated poses": ("room-noise", None),
    "RedKitchen, estimated poses": ("redkitchen", None),
}
_OUTLIER = 0.2
_KEYFRAMES = 6
# Keyframes on each side that a keyframe is compared with.
_AROUND = 3
_NEAR_PERCENT, _FAR_PERCENT = 2.0, 98.0
DESCRIPTION = f"""\
Depth of {_KEYFRAMES} evenly spaced keyframes, with the poses of the dataset ("true", which are good
to 1-2 cm on RedKitchen and to some centimetres on the HoloLens walk) or those estimated by
`--depth none`, at the scale that fits the trajectory. Density: fraction of the pixels with true
depth that have a measured one; its median relative error, and the fraction with an error above
{_OUTLIER:.0%}.
Within 1 and 2 sigma: fraction of errors below the estimated standard deviation and below twice
that, 68 and 95 % if it is right and errors are normal, after the common scale of the keyframe's
depth has been removed, which all keyframes share and which the deviation cannot contain;
"unscaled": without that. Depth of the rooms with sensor noise, of RedKitchen and of the
HoloLens walk has errors of its own. Inferred: the same for depth that was completed on planes, as
a fraction of the same pixels. Times are medians of one keyframe on all threads."""


def measure(job: list[str | int | None], _seed: int) -> Metrics:
    """Depth of some keyframes of a sequence."""
    dataset = opened(str(job[0]))
    step = job[1]
    views = _estimated(dataset) if step is None else _true(dataset, int(step))
    images = {view.frame: intensity_of(dataset[view.frame].rgb).numpy() for view in views}
    times: dict[str, list[float]] = {"sweep_ms": [], "consensus_ms": [], "completion_ms": []}
    depths = []
    for number in np.unique(np.linspace(_AROUND, len(views) - 1 - _AROUND, _KEYFRAMES).astype(int)):
        estimator = MultiViewDepth(dataset.camera, views, lambda frame: images[frame])
        _, first_ms = _timed(partial(estimator.measured, number))
        _, consensus_ms = _timed(partial(estimator.measured, number))
        found = estimator.completed(number)
        # The next keyframe is the only one around it that has not been completed.
        _, completed_ms = _timed(partial(estimator.completed, number + 1))
        sweep_ms = (first_ms - consensus_ms) / (2 * _AROUND + 1)
        times["sweep_ms"].append(sweep_ms)
        times["consensus_ms"].append(consensus_ms)
        times["completion_ms"].append(completed_ms - consensus_ms - sweep_ms)
        depths.append((found, dataset[views[number].frame].depth_m))
    return _quality(depths) | {name: float(np.median(values)) for name, values in times.items()}


def _timed(run: Callable[[], Found]) -> tuple[Found, float]:
    begin = time.perf_counter()
    found = run()
    return found, 1e3 * (time.perf_counter() - begin)


def _true(dataset: RecordedDataset, step: int) -> list[SweptKeyframe]:
    truth = dataset.ground_truth
    assert truth is not None
    views = []
    for index in range(0, len(dataset), step):
        depth = dataset[index].depth_m
        near, far = np.percentile(depth[depth > 0], [_NEAR_PERCENT, _FAR_PERCENT])
        views.append(SweptKeyframe(index, truth.T_world_camera[index], float(near), float(far)))
    return views


def _estimated(dataset: RecordedDataset) -> list[SweptKeyframe]:
    """Keyframes of the estimated motion, at the scale that fits the true trajectory."""
    motion, truth = estimate_motion(dataset, dataset.camera), dataset.ground_truth
    assert truth is not None
    found = np.array([view.T_world_camera[:3, 3] for view in motion.views])
    true = truth.T_world_camera[[view.frame for view in motion.views], :3, 3]
    scale = float(np.sqrt(true.var(0).sum() / found.var(0).sum()))
    views = []
    for view in motion.views:
        T = view.T_world_camera.copy()
        T[:3, 3] *= scale
        views.append(view.scaled(T, scale))
    return views


def _quality(depths: list[tuple[EstimatedDepth, NDArray[np.float32]]]) -> Metrics:
    parts = []
    for inferred in (False, True):
        errors, scaled, sigmas, true_pixels = [], [], [], 0
        for found, true in depths:
            chosen = (found.depth > 0) & (true > 0) & (found.inferred == inferred)
            true_pixels += int((true > 0).sum())
            ratio = found.depth[chosen] / true[chosen]
            measured = (found.depth > 0) & (true > 0) & ~found.inferred
            common = np.median(found.depth[measured] / true[measured])
            errors.append(np.abs(ratio - 1.0))
            scaled.append(np.abs(ratio / common - 1.0))
            sigmas.append(found.relative_sigma[chosen])
        error, free, sigma = (np.concatenate(part) for part in (errors, scaled, sigmas))
        parts.append(
            {
                "density_percent": 100.0 * len(error) / true_pixels,
                "median_error_percent": 100.0 * float(np.median(error)),
                "outliers_percent": 100.0 * float((error > _OUTLIER).mean()),
                "within_1_sigma_percent": 100.0 * float((free < sigma).mean()),
                "within_2_sigma_percent": 100.0 * float((free < 2.0 * sigma).mean()),
                "within_1_sigma_unscaled_percent": 100.0 * float((error < sigma).mean()),
            }
        )
    measured_part, completed = parts
    names = ("median_error_percent", "outliers_percent", "within_1_sigma_percent")
    return {
        **measured_part,
        "inferred_percent": completed["density_percent"],
        **{f"inferred_{name}": completed[name] for name in names},
    }


PAGE = Page(
    "multi_view_depth",
    "Multi-view depth",
    DESCRIPTION,
    {name: list(row) for name, row in ROWS.items()},
    measure,
    lambda rows: [table_of(COLUMNS, rows, "sequence")],
)

if __name__ == "__main__":
    PAGE.main()
