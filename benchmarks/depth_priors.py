"""Depth priors without a sensor: scale correction with the map, and completion of keyframes.

python -m benchmarks.depth_priors [--only NAMES]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.degraded_depth import Degradation, DegradedDepth
from benchmarks.recordings import room
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.images_only import ImagesOnly
from toolkit.datasets.registry import open_dataset
from toolkit.depth.depth_priors.alignment import ScaleShift
from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.depth.depth_priors.options import DepthPriorOptions, ScaleCorrectionOptions
from toolkit.depth.monocular.motion import CameraMotion, estimate_motion
from toolkit.depth.monocular.sequence import MonocularSequence, prior_correction
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.settings import RunSettings
from toolkit.slam.system import Slam

SETS = (8, 4)
_VIEWS = 12
_LITERAL = {"robust": False, "grid": 1, "share": "frame", "filter": False}
GIVEN, ODOMETRY, LITERAL = "given poses", "estimated poses", "H-16 as printed, given poses"
# Name, poses, correction, degradation.
CORRECTED: dict[str, dict] = {
    GIVEN: {"poses": "given"},
    ODOMETRY: {"poses": "estimated"},
    "exact up to scale and shift, given poses": {
        "poses": "given",
        "degradation": {"noise": 0.0, "outliers": 0.0},
    },
    LITERAL: {"poses": "given", "correction": _LITERAL},
}
GEOMETRIC, ONE_SCALE, GRID = "neighbouring keyframes alone", "one scale and shift", "grid"
_BENT = {"noise": 0.02, "outliers": 0.05, "bend": 0.1, "affine": True}
COMPLETED: dict[str, dict] = {
    GEOMETRIC: {},
    ONE_SCALE: {"correction": {"grid": 1}, "degradation": _BENT},
    GRID: {"correction": {"grid": 3}, "degradation": _BENT},
}
CORRECTION_COLUMNS = (
    *("sets", "scale_error_median_percent", "scale_error_max_percent"),
    *("shift_error_median_percent", "shift_error_max_percent", "ate_rmse_cm"),
    *("map_depth_error_percent", "map_depth_bias_percent", "keyframes", "frames"),
)
COMPLETION_COLUMNS = (
    *("depth_density_percent", "depth_median_error_percent", "depth_outliers_percent"),
    *("inferred_percent", "inferred_median_error_percent", "inferred_outliers_percent"),
)
_OUTLIER = 0.2
DESCRIPTION = f"""\
The default synthetic room, 320x240 pixels. The prior is true depth, degraded: an unknown scale
(factor 0.5 to 2) and shift (up to 0.4 m) for each set of {SETS[0]} frames at a stride of {SETS[1]},
except the first one; 20 % noise and 30 % outliers in every pixel.

Correction (`--depth-prior.use correct`): errors of scale and shift of each set after the run (shift
relative to the median depth), against the truth, or with estimated poses against the truth in the
unit of the first set. Given poses have no ATE; that of estimated poses is after Sim(3) alignment.
Depth error: median over the pixels of {_VIEWS} keyframes of the map rendered there.

Completion (`--depth-prior.use complete`): depth of {_VIEWS} keyframes, estimated poses, at the
scale of the Sim(3) alignment. The prior has 2 % noise, 5 % outliers, and a smooth error of 10 % RMS
that differs between frames. Errors above {_OUTLIER:.0%} are outliers. Inferred: pixels from the
prior."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure corrected and completing depth priors."""

    frames: int = 300
    """Number of frames."""


def main() -> None:
    """Measure all rows."""
    options = tyro.cli(Options)
    report = Report("depth_priors", "Depth priors", DESCRIPTION, options)
    corrected = report.measured(
        {name: job | {"frames": options.frames} for name, job in CORRECTED.items()}, correct
    )
    completed = report.measured(
        {name: job | {"frames": options.frames} for name, job in COMPLETED.items()}, complete
    )
    report.write(
        table_of(CORRECTION_COLUMNS, corrected, "poses", title="Correction"),
        table_of(COMPLETION_COLUMNS, completed, "depth", title="Completion"),
        target_table(targets(corrected, completed)),
    )


def correct(job: dict, seed: int) -> Metrics:
    """Map the room with corrected priors alone."""
    dataset, prior = _opened(job, seed)
    options = DepthPriorOptions(
        kind="maps",
        use="correct",
        size=SETS[0],
        stride=SETS[1],
        correction=replace(ScaleCorrectionOptions(), **job.get("correction", {})),
    )
    metrics: Metrics = {"frames": len(dataset)}
    blind = ImagesOnly(dataset)
    sequence: ImagesOnly | MonocularSequence = blind
    scale = 1.0
    if job["poses"] == "given":
        correction = prior_correction(blind, prior, options, needs_reference=False)
    else:
        motion = estimate_motion(blind, dataset.camera)
        sequence = MonocularSequence(blind, motion, prior, options)
        found = sequence.correction()
        assert found is not None
        correction = found
        metrics["ate_rmse_cm"], scale = _ate(motion, dataset)
    poses: Literal["given", "slam"] = "given" if job["poses"] == "given" else "slam"
    settings = RunSettings(depth="none", poses=poses, seed=seed)
    code = replace(settings.semantics.code, kind="none")
    settings = replace(settings, semantics=replace(settings.semantics, code=code))
    slam = build_slam(sequence, settings, correction=correction)
    for index in range(len(dataset)):
        slam.process_frame(sequence[index])
    slam.finish()
    # Groups are frames if each frame has a correction of its own.
    truth = prior.truth_of if options.correction.share == "frame" else prior.truth
    metrics |= _set_errors(correction, truth, float(np.median(dataset[0].depth_m)))
    return metrics | _map_errors(slam, dataset, scale)


def complete(job: dict, seed: int) -> Metrics:
    """Complete the depth of keyframes."""
    dataset, prior = _opened(job, seed)
    options = DepthPriorOptions(
        kind="maps", correction=replace(ScaleCorrectionOptions(), **job.get("correction", {}))
    )
    motion = estimate_motion(ImagesOnly(dataset), dataset.camera)
    used = prior if "degradation" in job else None
    sequence = MonocularSequence(dataset, motion, used, options)
    scale = _ate(motion, dataset)[1]
    errors, inferred, pixels = [], [], 0
    for number in _spread(len(motion.views)):
        index = motion.views[number].frame
        frame, true = sequence[index], dataset[index].depth_m
        both = (frame.depth_m > 0) & (true > 0)
        pixels += int((true > 0).sum())
        errors.append(np.abs(scale * frame.depth_m[both] / true[both] - 1.0))
        mask = np.zeros(both.shape, bool) if frame.inferred is None else frame.inferred
        inferred.append(mask[both])
    error, from_prior = np.concatenate(errors), np.concatenate(inferred)
    metrics = {
        "depth_density_percent": 100.0 * len(error) / pixels,
        "depth_median_error_percent": 100.0 * float(np.median(error)),
        "depth_outliers_percent": 100.0 * float((error > _OUTLIER).mean()),
        "inferred_percent": 100.0 * float(from_prior.mean()),
    }
    if from_prior.any():
        own = error[from_prior]
        metrics["inferred_median_error_percent"] = 100.0 * float(np.median(own))
        metrics["inferred_outliers_percent"] = 100.0 * float((own > _OUTLIER).mean())
    return metrics


def _opened(job: dict, seed: int) -> tuple[RecordedDataset, DegradedDepth]:
    dataset = open_dataset("synthetic", room("room"), max_frames=job["frames"])
    how = Degradation(**(asdict(Degradation()) | job.get("degradation", {})))
    return dataset, DegradedDepth(dataset, how, *SETS, seed)


def _ate(motion: CameraMotion, dataset: RecordedDataset) -> tuple[float, float]:
    """ATE in cm of an estimated motion, and metres per unit of its length."""
    assert dataset.ground_truth is not None
    error = absolute_trajectory_error(motion.trajectory, dataset.ground_truth, "sim3")
    return 100.0 * error.rmse_m, error.alignment.scale


def _set_errors(
    correction: DepthCorrection, truth: Callable[[int], ScaleShift], median_m: float
) -> Metrics:
    """Errors of scale and shift, in the unit of the first set."""
    first, *others = correction.found
    unit = correction.found[first].scale / truth(first).scale
    scale, shift = [], []
    for group in others:
        found, true = correction.found[group], truth(group)
        scale.append(abs(found.scale / (unit * true.scale) - 1.0))
        shift.append(abs(found.shift / unit - true.shift) / median_m)
    return {
        "sets": len(others),
        "scale_error_median_percent": 100.0 * float(np.median(scale)),
        "scale_error_max_percent": 100.0 * max(scale),
        "shift_error_median_percent": 100.0 * float(np.median(shift)),
        "shift_error_max_percent": 100.0 * max(shift),
    }


def _map_errors(slam: Slam, dataset: RecordedDataset, scale: float) -> Metrics:
    """Depth of the map rendered at its keyframes, compared with the truth."""
    errors = []
    submap = slam.atlas.submap(0)
    keyframes = submap.keyframes
    for number in _spread(len(keyframes)):
        keyframe = keyframes[number]
        depth = scale * slam.mapper.view(submap, keyframe).depth_m.numpy()
        true = dataset[keyframe.index].depth_m
        both = (depth > 0) & (true > 0)
        errors.append(depth[both] / true[both] - 1.0)
    error = np.concatenate(errors)
    return {
        "map_depth_error_percent": 100.0 * float(np.median(np.abs(error))),
        "map_depth_bias_percent": 100.0 * float(np.median(error)),
        "keyframes": len(keyframes),
    }


def _spread(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, _VIEWS).astype(np.int64))


def targets(corrected: Rows, completed: Rows) -> list[Target]:
    """What the defaults should reach."""
    by_pose, by_depth = median_of(corrected), median_of(completed)
    one, grid = (by_depth(name, "inferred_median_error_percent") for name in (ONE_SCALE, GRID))
    scale, shift = "scale_error_max_percent", "shift_error_max_percent"
    return [
        Target("scale of every set, in percent", by_pose(GIVEN, scale), at_most=1.0),
        Target("shift of every set, in percent", by_pose(GIVEN, shift), at_most=1.0),
        Target("ATE in cm", by_pose(ODOMETRY, "ate_rmse_cm"), at_most=1.0),
        *(
            []
            if one is None
            else [Target("inferred depth, grid against one scale", grid, at_most=0.5 * one)]
        ),
    ]


if __name__ == "__main__":
    main()
