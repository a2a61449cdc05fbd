"""Hier-SLAM++'s monocular system: frames tracked against the map with corrected depth priors.

SEMSPLAT_DATA=DATA python -m benchmarks.monocular.prior_tracking [--only NAMES]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.monocular.motion_errors import path_m
from benchmarks.shared.recordings import RECORDINGS, room
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import finished_slam
from benchmarks.shared.tables import Metrics, part_table
from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.base.options import as_plain, validated
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.depth.depth_priors.alignment import ScaleShift
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    DepthProvider,
    Image,
    PriorModel,
    PriorSet,
    ScaleScope,
    frame_sets,
)
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.modes import RunContext, mode_of
from toolkit.runs.observers import no_progress
from toolkit.runs.settings import PresetName, RunSettings, load_settings
from toolkit.slam.system import Slam

SIZE, FRAMES = (160, 120), 40
SETS = (8, 4)
Values = dict[str, Any]
# How true depth is degraded to a prior.
PRIORS: dict[str, Values] = {
    "exact": {"noise": 0.0, "outliers": 0.0},
    "smooth errors": {"noise": 0.02, "outliers": 0.05, "bend": 0.03},
    "noise": {"noise": 0.2, "outliers": 0.3},
}
_SHARE: Values = {"share": "scope"}
_FILTERED: Values = {"share": "scope", "robust": True, "filter": True}
# Options of the correction beside H-16 as printed.
MENDED: dict[str, Values] = {
    "as printed": {},
    "shared by the set": {"correction": _SHARE},
    "shared, robust, filtered": {"correction": _FILTERED},
}
SEQUENCES = {"room": tuple(PRIORS), "redkitchen": ("smooth errors",)}
_OURS: Values = {"preset": "default"}
_ODOMETRY: Values = {"use": "complete", "tracking": "dense"}
_SYSTEM_COLUMNS = (
    *("ate_rmse_cm", "scale_error_median_percent", "scale_error_last_percent", "psnr_db"),
    *("depth_error_percent", "lost", "path_cm"),
)
DESCRIPTION = f"""\
Preset `hier-slam-mono` without semantics: the first {FRAMES} frames of the default synthetic room
and of RedKitchen at {SIZE[0]}x{SIZE[1]}, each of them mapped with 60 iterations. Priors have an
unknown scale (factor 0.5 to 2) and shift (up to 0.4 m) for each set of {SETS[0]} frames at a
stride of {SETS[1]}, except the first one. `exact` has no other error; `smooth errors` 2 % noise,
5 % outliers and a smooth error of 3 % RMS that differs between frames; `noise` 20 % noise and 30 %
outliers.

ATE: after Sim(3) alignment. Scale error: of the median depth of keyframes, relative to that of the
first quarter of them; median over the keyframes, and of the last one. Depth error: median over the
pixels of all keyframes, in the same unit. The path is the camera's. As printed: every frame has a
scale and a shift of its own, by least squares. Shared: the frames of a set have the same."""


@dataclass(frozen=True)
class Degradation:
    """What a prior does to true depth.

    Attributes:
        noise: standard deviation relative to the depth, independent between pixels.
        outliers: fraction of the pixels with any depth up to three times the median.
        bend: RMS of a smooth factor on the depth, which differs between frames.
    """

    noise: float
    outliers: float
    bend: float = 0.0


class DegradedDepth:
    """True depth with an unknown scale and shift per set of frames, noise and outliers.

    The first set has the scale 1 and the shift 0.

    Args:
        dataset: with true depth.
        size, stride: of the sets.
        seed: of all random values.
    """

    joint = False
    model = PriorModel("degraded true depth", licence="none")

    def __init__(
        self, dataset: Dataset, degradation: Degradation, size: int, stride: int, seed: int
    ) -> None:
        self._dataset, self._degradation, self._seed = dataset, degradation, seed
        sets = frame_sets(len(dataset), size, stride)
        self._set_of = {index: n for n, members in enumerate(sets) for index in members}

    def truth(self, number: int) -> ScaleShift:
        """The correction of a set: depth = scale * value + shift, in metres."""
        if number == 0:
            return ScaleShift(1.0)
        rng = np.random.default_rng((self._seed, 0, number))
        return ScaleShift(float(np.exp(rng.uniform(-0.7, 0.7))), float(rng.uniform(-0.4, 0.4)))

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Degraded depth of some frames."""
        priors = tuple(
            DepthPrior(self._values(f.index), DepthKind.AFFINE, ScaleScope.SET, self.model)
            for f in frames
        )
        return PriorSet(tuple(f.index for f in frames), priors)

    def _values(self, index: int) -> Image:
        depth = self._dataset[index].depth_m.astype(np.float64)
        rng, how = np.random.default_rng((self._seed, 1, index)), self._degradation
        true = self.truth(self._set_of[index])
        values = (depth * _bend(depth.shape, how.bend, rng) - true.shift) / true.scale
        values *= 1.0 + how.noise * rng.standard_normal(depth.shape)
        wrong = rng.uniform(0.0, 3.0, depth.shape) * np.median(values[depth > 0])
        values = np.where(rng.random(depth.shape) < how.outliers, wrong, values)
        return np.where(depth > 0, values, np.nan).astype(np.float32)


def _bend(shape: tuple[int, ...], rms: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth factor [H, W] of mean 1: waves of half to one period across the image."""
    y, x = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in shape), indexing="ij")
    periods, phase = rng.uniform(-1.0, 1.0, 2), rng.uniform(0.0, 2.0 * np.pi)
    wave = np.cos(2.0 * np.pi * (periods[0] * x + periods[1] * y) + phase)
    return np.asarray(1.0 + rms * np.sqrt(2.0) * (wave - wave.mean()))


def jobs() -> dict[str, Values]:
    """All rows by table and name."""
    found: dict[str, Values] = {}
    for sequence, priors in SEQUENCES.items():
        rows: dict[str, Values] = {"RGB-D, preset hier-slam": {"preset": "hier-slam"}}
        for prior in priors:
            rows |= {f"{prior}, {name}": {"prior": prior} | v for name, v in MENDED.items()}
        if sequence == "room":
            rows["smooth errors, shared, robust, filtered, dense tracker"] = {
                "prior": "smooth errors",
                "correction": _FILTERED,
                "tracking": "dense",
            }
            rows["no prior, our odometry, mapping of the preset"] = _ODOMETRY
        rows["no prior, our default"] = _ODOMETRY | _OURS
        found |= {f"{sequence}: {name}": {"sequence": sequence} | row for name, row in rows.items()}
    return found


def measure(job: Values, seed: int) -> Metrics:
    """Run a system on one sequence."""
    provider = None if "prior" not in job else _provider(job["sequence"], job["prior"], seed)
    return _measured(_settings(job, seed), _dataset(job["sequence"]), provider)


def _settings(job: Values, seed: int) -> RunSettings:
    preset: PresetName = job.get("preset", "hier-slam-mono")
    values = as_plain(load_settings(preset=preset))
    values["seed"] = seed
    values["semantics"]["code"]["kind"] = "none"
    if preset == "hier-slam":
        return validated(RunSettings, values)
    values["depth"] = "none"
    prior = values["depth_prior"]
    prior |= {"kind": "maps" if "prior" in job else "none", "use": job.get("use", "track")}
    prior["correction"] |= job.get("correction", {})
    values["tracking"]["kind"] = job.get("tracking", "first-order")
    return validated(RunSettings, values)


def _measured(
    settings: RunSettings, dataset: RecordedDataset, provider: DepthProvider | None
) -> Metrics:
    mode = mode_of(settings)
    mode.check(settings)
    source = mode.open(RunContext(settings, dataset, StageRecorder(), provider, no_progress))
    systems: list[Slam] = []
    with finished_slam(settings, dataset, systems.append, source) as run:
        truth = dataset.ground_truth
        assert truth is not None
        keyframes = [k for number in range(len(systems[0].atlas)) for k in _own(systems[0], number)]
        return {
            "ate_rmse_cm": run.metrics["trajectory.ate_rmse_cm"],
            "psnr_db": run.metrics["images.mapped.psnr_db"],
            "lost": run.metrics["frames.lost"],
            "path_cm": 100.0 * path_m(truth),
            **_depth_errors(keyframes, dataset),
        }


def _own(slam: Slam, number: int) -> list[Keyframe]:
    return slam.atlas.submap(number).keyframes


def _depth_errors(keyframes: Sequence[Keyframe], dataset: RecordedDataset) -> Metrics:
    """Errors of the depth of keyframes, in the unit of the first quarter of them."""
    ratios = {}
    for keyframe in keyframes:
        depth, true = keyframe.depth_m.numpy(), dataset[keyframe.index].depth_m
        both = (depth > 0) & (true > 0)
        if both.any():
            ratios[keyframe.index] = depth[both] / true[both]
    medians = np.array([np.median(ratio) for ratio in ratios.values()])
    unit = np.median(medians[: max(1, len(medians) // 4)])
    errors = np.concatenate([np.abs(ratio / unit - 1.0) for ratio in ratios.values()])
    scale = np.abs(medians / unit - 1.0)
    return {
        "scale_error_median_percent": 100.0 * float(np.median(scale)),
        "scale_error_last_percent": 100.0 * float(scale[-1]),
        "depth_error_percent": 100.0 * float(np.median(errors)),
    }


def _dataset(sequence: str) -> RecordedDataset:
    if sequence == "room":
        return open_dataset("synthetic", room("room"), SIZE, max_frames=FRAMES)
    recording = RECORDINGS[sequence]
    return open_dataset(recording.kind, recording.path, SIZE, max_frames=FRAMES)


def _provider(sequence: str, prior: str, seed: int) -> DepthProvider:
    return DegradedDepth(_dataset(sequence), Degradation(**PRIORS[prior]), *SETS, seed)


TITLES = {"room": "Systems, synthetic room", "redkitchen": "Systems, RedKitchen"}
PAGE = Page(
    "prior_tracking",
    "Tracking on depth priors",
    DESCRIPTION,
    jobs(),
    measure,
    lambda rows: [
        part_table(part, _SYSTEM_COLUMNS, rows, title, first_column="row")
        for part, title in TITLES.items()
    ],
)

if __name__ == "__main__":
    PAGE.main()
