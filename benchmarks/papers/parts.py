"""Measurements of the papers' tables that are no runs: registration, and loop candidates."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.registration_methods import Methods
from benchmarks.loops.registration_pairs import draw_pairs, pool
from benchmarks.loops.registration_pairs import room as room_recording
from benchmarks.loops.registration_trials import judged
from benchmarks.shared.recordings import room
from benchmarks.shared.tables import Metrics
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.io.arrays import arrays_below
from toolkit.runs.building import build_run_labeller, build_slam
from toolkit.runs.evaluation.loops import TrueViews, loop_metrics
from toolkit.runs.evaluation.metrics import flattened
from toolkit.runs.evaluation.run_loops import true_views
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.factory import build_encoder
from toolkit.semantics.features.options import FeatureOptions
from toolkit.slam.loops.candidates import CandidateFinder, DescribedKeyframe
from toolkit.slam.loops.class_counts import ClassCounter, GaussianClassCounter, PixelClassCounter
from toolkit.slam.loops.options import CandidateOptions, Counted, LandmarkOptions
from toolkit.splatting.rendering import backend

Values = dict[str, Any]

PAIRS = 8  # of each room
# No class is ever seen as often, so that landmarks have no effect.
_NEVER = 10**9
# Landmarks of observed Gaussians (G-7), by encoder.
LANDMARKS: dict[str, Values] = {
    f"{encoder}, {row}": {"encoder": encoder, "landmarks": landmarks}
    for encoder in ("vlad", "builtin")
    for row, landmarks in {
        "descriptor alone": {"min_count": _NEVER},
        "pixels, square root (default weighting)": {},
        "pixels, linear": {"weighting": "linear"},
        "pixels, inverse": {"weighting": "inverse"},
        "Gaussians, square root": {"counted": "gaussians"},
        "Gaussians, as printed (G-7)": {"counted": "gaussians", "weighting": "paper"},
    }.items()
}
LANDMARKS_NOTE = """\
Candidates of the search on the ring, before verification, as in Algorithm 1: below the encoder's \
descriptor distance (`--loops.candidates.threshold fixed`), the closest landmark vector is the \
loop (`.kept 1`). One run of the default system, without refinement, counts both; every keyframe \
is then searched for among the earlier ones."""


def searched(encoder_kind: str, values: Values, seed: int) -> Metrics:
    """Loop metrics of the candidates of every keyframe of the ring, with one kind of landmarks."""
    landmarks = LandmarkOptions(**values)
    encoder = build_encoder(validated(FeatureOptions, {"kind": encoder_kind}))
    ring = counted_ring(encoder_kind, seed)
    options = CandidateOptions(search_every=1, threshold="fixed", kept=1)
    finder = CandidateFinder(encoder.dimensions, encoder.threshold, options, landmarks)
    found = [c for k in ring.keyframes[landmarks.counted] for c in finder.add(k) if c.accepted]
    frames = [keyframe.frame for keyframe in ring.keyframes[landmarks.counted]]
    metrics = loop_metrics(ring.views, frames, [(c.query, c.match) for c in found])
    return {"searched": len(frames), **flattened(metrics)}


@dataclass(frozen=True)
class CountedRing:
    """The keyframes of a ring as loop detection knows them, by what is counted; the truth."""

    keyframes: dict[Counted, list[DescribedKeyframe]]
    views: TrueViews


@functools.cache
def counted_ring(encoder_kind: str, seed: int) -> CountedRing:
    """The keyframes of a run of the default system with an encoder, without refinement."""
    path = room("ring-small", seed)
    values = {
        "dataset": {"kind": "synthetic", "path": str(path)},
        "loops": {"features": {"kind": encoder_kind}},
        "seed": seed,
    }
    settings = validated(RunSettings, values)
    dataset = open_dataset("synthetic", path, None)
    slam = build_slam(dataset, settings)
    labeller = build_run_labeller(settings, dataset)
    assert labeller is not None
    semantics, classes = slam.mapper.semantics, len(labeller.taxonomy)
    counters: dict[Counted, ClassCounter] = {
        "pixels": PixelClassCounter(classes),
        "gaussians": GaussianClassCounter(semantics, classes, backend(), whole=True),
    }
    counts: dict[Counted, dict[int, tuple[NDArray, NDArray | None]]] = {
        name: {} for name in counters
    }
    for index in range(len(dataset)):
        if slam.process_frame(dataset[index]).mapping is not None:
            newest = slam.atlas.keyframes[-1]
            for counted, counter in counters.items():
                gaussians = slam.atlas.gaussians
                counts[counted][index] = (
                    counter.counts(newest, gaussians),
                    counter.submap_counts(gaussians),
                )
    arrays = arrays_below(slam.state()[0], "closer/detector/")
    rows = list(
        zip(
            arrays["frames"],
            arrays["submaps"],
            arrays["travelled_m"],
            arrays["descriptors"],
            strict=True,
        )
    )
    keyframes = {
        counted: [
            DescribedKeyframe(int(frame), int(submap), float(way), descriptor, *mine[int(frame)])
            for frame, submap, way, descriptor in rows
        ]
        for counted, mine in counts.items()
    }
    return CountedRing(keyframes, true_views(dataset))


def registered(method: str, seed: int) -> Metrics:
    """Success rate and median errors of a method over the pairs of a room."""
    generator = np.random.default_rng([seed, 0])
    recording = room_recording(300, (160, 120), seed, noise=False)
    pieces = pool(recording, generator)
    pairs = draw_pairs(pieces, PAIRS, recording.semantics, generator, f"room {seed}")
    trials = [judged(method, pair, Methods(pair, seed).rows[method]()) for pair in pairs]
    return {
        "success_percent": 100.0 * float(np.mean([trial.success for trial in trials])),
        "error_cm": 100.0 * float(np.median([trial.error_m for trial in trials])),
        "error_deg": float(np.median([trial.error_deg for trial in trials])),
    }
