"""Parts of the papers beside the defaults: what each is worth. Quality alone, no times.

    SEMSPLAT_DATA=DATA python -m benchmarks.papers

Parts: tracking (G-2), colour (G-3), network (H-12), registration (G-6), landmarks (G-7), correction
(G, III.C).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import RECORDINGS, room
from benchmarks.registration_methods import Methods
from benchmarks.registration_pairs import draw_pairs, pool
from benchmarks.registration_pairs import room as room_recording
from benchmarks.registration_trials import judged
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, part_table
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
PartName = Literal["tracking", "colour", "network", "registration", "landmarks", "correction"]

DESCRIPTION = """\
What the papers do and the defaults do not, beside the defaults: median over the seeds. Synthetic
rings of rooms have 450 frames of 160x120 pixels with sensor noise, one ring for each seed; office0
(300x170) and RedKitchen (160x120) have one recording and several seeds of the random choices. Each
row changes the settings that it names and nothing else."""

_GIVEN: Values = {"poses": "given", "hold_out": 5}
# No class is ever seen as often, so that landmarks have no effect.
_NEVER = 10**9
_COLOUR: Values = {"code": {"kind": "colour"}}
_GAUSEM: Values = {"kind": "first-order", "first_order": {"preset": "gausem"}}


@dataclass(frozen=True)
class Part:
    """One table.

    Attributes:
        title: of the table.
        sequences: on which each row is run; empty where the rows are no runs.
        columns: of metrics.json and of `measure`.
        rows: settings by the name of the row; of rows that are no runs, what `measure` takes.
        note: below the table.
    """

    title: str
    sequences: tuple[str, ...]
    columns: tuple[str, ...]
    rows: dict[str, Values]
    note: str = ""


PARTS: dict[PartName, Part] = {
    "tracking": Part(
        "Semantics in tracking (G-2)",
        ("office0",),
        (
            "trajectory.ate_rmse_cm",
            "images.mapped.psnr_db",
            "semantics.mapped.miou_percent",
            "frames.lost",
        ),
        {
            "dense tracker (default)": {},
            "gausem preset without semantics": {
                "tracking": {
                    "kind": "first-order",
                    "first_order": {"preset": "gausem", "semantic": 0.0},
                }
            },
            "gausem preset": {"tracking": _GAUSEM},
        },
    ),
    "colour": Part(
        "SSIM on the semantic colour (G-3)",
        ("office0",),
        (
            "images.mapped.psnr_db",
            "semantics.mapped.miou_percent",
            "semantics.unseen.miou_percent",
            "semantics.mapped.level_0.miou_percent",
            "semantics.mapped.ece_percent",
        ),
        {
            "one-hot code (default)": _GIVEN,
            "colour code, L1": {**_GIVEN, "semantics": _COLOUR},
            "colour code, 0.8 L1 + 0.2 (1 - SSIM)": {
                **_GIVEN,
                "semantics": {**_COLOUR, "loss": {"structure": 0.2}},
            },
        },
        "Poses are given and every fifth frame is held out. `unseen` views are those.",
    ),
    "network": Part(
        "One inter-level network for all submaps (H-12)",
        ("office0, many submaps",),
        (
            "semantics.mapped.miou_percent",
            "semantics.unseen.miou_percent",
            "semantics.mapped.level_0.miou_percent",
            "semantics.mapped.ece_percent",
            "submaps",
        ),
        {
            "read by path, no network (default)": _GIVEN,
            "read by the network, no rehearsal": {
                **_GIVEN,
                "semantics": {"network": {"use": True, "replay": 0}, "reader": "network"},
            },
            "read by the network": {
                **_GIVEN,
                "semantics": {"network": {"use": True}, "reader": "network"},
            },
        },
        "Poses are given, every fifth frame is held out, and submaps end after five keyframes.",
    ),
    "registration": Part(
        "The feature term of registration (G-6)",
        (),
        ("success_percent", "error_cm", "error_deg"),
        {
            row: {"method": row}
            for row in (
                "SGR",
                "SGR, first-order fine, no feature term",
                "SGR, first-order fine (G-6)",
            )
        },
        "Pairs of submaps of synthetic rooms with ideal images, 160x120, each in a frame of its "
        "own; success is 5 cm and 2 degrees, errors are medians over the pairs. SGR is the "
        "default. Both first-order rows minimise colour and semantics; the last one adds the "
        "feature term with the built-in encoder.",
    ),
    "landmarks": Part(
        "Landmarks of observed Gaussians (G-7)",
        (),
        (
            "overlap.precision_percent",
            "overlap.recall_percent",
            "overlap.f1_percent",
            "searched",
            "accepted",
        ),
        {
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
        },
        "Candidates of the search on the ring, before verification, as in Algorithm 1: below the "
        "encoder's descriptor distance (`--loops.candidates.threshold fixed`), the closest "
        "landmark vector is the loop (`.kept 1`). One run of the default system, without "
        "refinement, counts both; every keyframe is then searched for among the earlier ones.",
    ),
    "correction": Part(
        "Mapping after a correction inside a submap (G, III.C)",
        ("redkitchen, always corrected", "ring, always corrected"),
        (
            "trajectory.ate_rmse_cm",
            "images.mapped.psnr_db",
            "semantics.mapped.miou_percent",
            "corrections",
            "largest correction cm",
        ),
        {
            "none": {"loops": {"closing": {"mapping_iterations": 0}}},
            "10 iterations a keyframe (default)": {},
        },
        "Keyframes are moved however little the loops contradict the odometry "
        "(`--loops.closing.drift-confidence 0.01`): at the default 0.99 neither sequence is "
        "corrected.",
    ),
}

_SIZES = {"office0": (300, 170), "redkitchen": (160, 120)}

# What a sequence changes besides the dataset.
_ALWAYS: Values = {"loops": {"closing": {"drift_confidence": 0.01}}}
_CHANGES: dict[str, Values] = {
    "office0, many submaps": {"submaps": {"allocation": {"max_keyframes": 5}}},
    "redkitchen, always corrected": _ALWAYS,
    "ring, always corrected": _ALWAYS,
}

PAIRS = 8  # of each room


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure parts of the papers beside the defaults."""

    parts: tuple[PartName, ...] = (
        "tracking",
        "colour",
        "network",
        "registration",
        "landmarks",
        "correction",
    )
    """Tables to measure; the results file has these."""
    seeds: int = 3
    """Seeds 0, 1, ... of rooms and runs."""


def main() -> None:
    """Measure the tables that were asked for."""
    options = tyro.cli(Options)
    report = Report(
        "papers",
        "Parts of the papers, beside the defaults",
        DESCRIPTION,
        options,
        range(options.seeds),
    )
    jobs = {f"{part}: {row}": job for part in options.parts for row, job in jobs_of(part).items()}
    found = report.measured(jobs, measure)
    report.write(
        *(
            part_table(part, PARTS[part].columns, found, PARTS[part].title, PARTS[part].note)
            for part in options.parts
        )
    )


def jobs_of(part: PartName) -> dict[str, Values]:
    """What each row of a table measures."""
    chosen = PARTS[part]
    if not chosen.sequences:
        return chosen.rows
    return {
        f"{sequence}, {row}": {"sequence": sequence, "settings": values}
        for sequence in chosen.sequences
        for row, values in chosen.rows.items()
    }


def measure(job: Values, seed: int) -> Metrics:
    """Metrics of one row with one seed."""
    if "method" in job:
        return registered(job["method"], seed)
    if "landmarks" in job:
        return searched(job["encoder"], job["landmarks"], seed)
    return measured_run(job["sequence"], job["settings"], seed)


def measured_run(sequence: str, values: Values, seed: int) -> Metrics:
    """metrics.json of a run, and what its corrections inside submaps did."""
    name = sequence.partition(",")[0]
    if name in RECORDINGS:
        recording = RECORDINGS[name]
        kind, path, size = recording.kind, recording.path, _SIZES[name]
    else:
        kind, path, size = "synthetic", room("ring-small", seed), None
    place = {"dataset": {"kind": kind, "path": str(path)}, "image_size": size, "seed": seed}
    settings = validated(RunSettings, merged(values, _CHANGES.get(sequence, {})) | place)
    with finished_slam(settings, open_dataset(kind, path, size)) as run:
        corrections = [r for r in run.records if r["kind"] == "correction within" and r["applied"]]
        return run.metrics | {
            "submaps": len(run.result.submaps),
            "corrections": len(corrections),
            "largest correction cm": max((100 * r["largest_m"] for r in corrections), default=0.0),
        }


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


def merged(one: Values, other: Values) -> Values:
    """Both nested dictionaries; the second one has precedence."""
    result = dict(one)
    for key, value in other.items():
        nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if nested else value
    return result


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


if __name__ == "__main__":
    main()
