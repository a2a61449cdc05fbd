"""What semantics add to each part of the system, where they should: changed and similar rooms.

    python -m benchmarks.thesis [descriptors loops seeding allocation registration]

Each part is a table with rows without and with semantics. `ring-small` is the ring of rooms of the
other benchmarks. In `ring-moved` and `ring-light`, most objects of the first room are elsewhere, or
its lamps are off, when the camera returns. In `twins-objects`, two rooms have equal walls and
different objects, and the camera returns to one of them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from benchmarks.loops import area_under_curve
from benchmarks.place_recognition import recall
from benchmarks.recordings import room
from benchmarks.registration_methods import Methods
from benchmarks.registration_pairs import SPACING, STEP, Pair, Recording, draw_pairs, piece
from benchmarks.registration_trials import judged
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, part_table
from toolkit.base.options import validated
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_run_labeller
from toolkit.runs.evaluation.loops import LoopTruthOptions, true_intervals
from toolkit.runs.evaluation.run_loops import true_views
from toolkit.runs.settings import RunSettings
from toolkit.semantics.factory import build_code
from toolkit.semantics.features.factory import build_describer
from toolkit.semantics.features.options import FeatureOptions
from toolkit.semantics.palette import Palette
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping

Values = dict[str, Any]
PartName = Literal["descriptors", "loops", "seeding", "allocation", "registration"]
Measure = Literal["descriptors", "seeding", "run", "registration"]

SCENES = ("ring-small", "twins-objects", "ring-moved", "ring-light")
EVERY = 5  # frames from one described frame to the next
PAIRS = 6  # of submaps, of each scene
KEYFRAMES = 7  # of a submap
SEEDED_FRAMES = 100

LOOPS = (
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "semantics.mapped.miou_percent",
    "submaps",
    "loops",
    "loops.verified.overlap.precision_percent",
    "loops.verified.overlap.recall_percent",
    "loops.edges.right_percent",
    "frames.lost",
)

DESCRIPTION = """\
What semantics add to one part of the system at a time. Sequences have 450 frames of 160x120 pixels
with sensor noise: a ring of four rooms (`ring-small`); the same ring with most objects of the first
room elsewhere (`ring-moved`) or with its lamps off (`ring-light`) when the camera returns; and
three rooms on a corridor of which two have equal walls and different objects (`twins-objects`).
Labels are those of the dataset with the sensor's errors."""


@dataclass(frozen=True)
class Part:
    """One table.

    Attributes:
        title, note: above and below it.
        scenes: on which each row is measured.
        columns: metrics.
        rows: what `measure` takes, by the name of the row.
        measure: how a row is measured.
    """

    title: str
    note: str
    scenes: tuple[str, ...]
    columns: tuple[str, ...]
    rows: dict[str, Values]
    measure: Measure


def _seeding(choice: str, share: float) -> Values:
    return {"mapping": {"seeding": {"choice": choice, "share": share}}}


PARTS: dict[PartName, Part] = {
    "descriptors": Part(
        "Descriptors",
        "Every fifth frame is compared with the earlier ones beyond the gap of the detector, at "
        "true poses. A true match overlaps by 30 % within 0.5 m. Recall@k: one of the k nearest is "
        "a true one. AUC: how often a true pair is nearer than another.",
        SCENES,
        ("recall@1 %", "recall@5 %", "AUC", "queries"),
        {
            f"{kind}, {source}{' (default)' if (kind, source) == ('vlad', 'rgb') else ''}": {
                "kind": kind,
                "source": source,
            }
            for kind in ("vlad", "builtin")
            for source in ("rgb", "semantic", "both")
        },
        "descriptors",
    ),
    "loops": Part(
        "Loops found with these descriptors",
        "Complete runs without the final refinement.",
        ("ring-light",),
        LOOPS,
        {
            "vlad, rgb (default)": {},
            "vlad, both": {"loops": {"features": {"source": "both"}}},
        },
        "run",
    ),
    "seeding": Part(
        "Seeding",
        f"The first {SEEDED_FRAMES} frames at true poses.",
        ("twins-objects",),
        (
            "images.mapped.psnr_db",
            "depth.mapped.l1_cm",
            "semantics.mapped.miou_percent",
            "map.gaussians",
        ),
        {
            "cells (default)": {},
            **{
                f"{choice}, {100 * share:.0f} % of the pixels": _seeding(choice, share)
                for share in (0.25, 0.5, 1.0)
                for choice in ("uniform", "semantic")
            },
        },
        "seeding",
    ),
    "allocation": Part(
        "Allocation of submaps",
        "Complete runs without the final refinement.",
        ("twins-objects",),
        LOOPS,
        {
            "overlap alone": {"submaps": {"allocation": {"min_divergence": 0.0}}},
            "overlap and classes (default)": {},
        },
        "run",
    ),
    "registration": Part(
        "Registration of submaps",
        f"{PAIRS} pairs of submaps of {KEYFRAMES} keyframes, mapped at true poses: one from the "
        "first third of the frames, one from the last. Success is 5 cm and 2 degrees; errors are "
        "medians over the successes. Wrong: failures that the verification of loops accepts. "
        "The first-order fine stage with semantics is in `papers.md`.",
        SCENES[1:],
        ("success %", "error cm", "error deg", "wrong", "pairs"),
        {
            "SGR, classes ignored": {"method": "SGR, classes ignored"},
            "SGR, pixels of other classes excluded (default)": {"method": "SGR"},
        },
        "registration",
    ),
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure what semantics add to the parts of the system."""

    parts: tyro.conf.Positional[tuple[PartName, ...]] = (
        "descriptors",
        "loops",
        "seeding",
        "allocation",
        "registration",
    )
    """Tables to measure; the results file has these."""
    seeds: int = 1
    """Seeds 0, 1, ... of rooms and runs; a row is their median."""


def main() -> None:
    """Measure the tables that were asked for."""
    options = tyro.cli(Options)
    seeds = range(options.seeds)
    report = Report("thesis", "What semantics add", DESCRIPTION, options, seeds)
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
    return {
        f"{scene}, {row}": {"part": chosen.measure, "scene": scene, "values": values}
        for scene in chosen.scenes
        for row, values in chosen.rows.items()
    }


def measure(job: Values, seed: int) -> Metrics:
    """Metrics of one row with one seed."""
    measures: dict[Measure, Callable[[str, Values, int], Metrics]] = {
        "descriptors": recognised,
        "seeding": seeded,
        "run": unrefined,
        "registration": registered,
    }
    return measures[job["part"]](job["scene"], job["values"], seed)


def recognised(scene: str, values: Values, seed: int) -> Metrics:
    """Recall and AUC of one descriptor over a sequence."""
    dataset = opened(scene, seed)
    labeller = build_run_labeller(RunSettings(), dataset)
    assert labeller is not None
    colours = Palette(labeller.taxonomy).classes.astype(np.float32) / 255.0
    describer = build_describer(validated(FeatureOptions, values))
    rows = []
    for index in range(0, len(dataset), EVERY):
        frame = dataset[index]
        images = frame.rgb, colours[labeller.label(frame).labels]
        rgb, semantic = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in images)
        with torch.no_grad():
            rows.append(describer.describe(rgb, semantic)[0].numpy())
    descriptors = np.array(rows, np.float64)
    similarity = descriptors @ descriptors.T
    truth, beyond = true_pairs(scene, seed)
    return {
        "recall@1 %": 100.0 * recall(similarity, truth, beyond, 1),
        "recall@5 %": 100.0 * recall(similarity, truth, beyond, 5),
        "AUC": area_under_curve(-similarity[beyond], truth[beyond]),
        "queries": int(truth.any(axis=1).sum()),
    }


@functools.cache
def true_pairs(scene: str, seed: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Described frames [K, K] that are a true loop, and those beyond the gap of the detector."""
    views = true_views(opened(scene, seed))
    frames = np.arange(0, len(views), EVERY)
    anywhere = LoopTruthOptions(max_distance_m=np.inf, min_overlap=0.0)
    pairs = np.ix_(frames, frames)
    return true_intervals(views)[pairs], true_intervals(views, anywhere)[pairs]


def seeded(scene: str, values: Values, seed: int) -> Metrics:
    """metrics.json of the start of a sequence at true poses."""
    return run(scene, values | {"poses": "given", "max_frames": SEEDED_FRAMES}, seed)


def unrefined(scene: str, values: Values, seed: int) -> Metrics:
    """metrics.json of a run without the final refinement."""
    return run(scene, values | {"mapping": {"final_iterations": 0}}, seed)


def run(scene: str, values: Values, seed: int) -> Metrics:
    """metrics.json of a run, and its submaps and loops between them."""
    place = {"dataset": {"kind": "synthetic", "path": str(room(scene, seed))}, "seed": seed}
    settings = validated(RunSettings, values | place)
    dataset = open_dataset("synthetic", room(scene, seed), None, settings.max_frames)
    with finished_slam(settings, dataset) as done:
        between = [r for r in done.records if r["kind"] == "correction between"]
        return done.metrics | {
            "submaps": len(done.result.submaps),
            "loops": between[-1]["loops"] if between else 0,
        }


def registered(scene: str, values: Values, seed: int) -> Metrics:
    """Success rate and median errors of a method over pairs of submaps."""
    method = values["method"]
    trials = [
        judged(method, pair, methods.rows[method]()) for pair, methods in methods_of(scene, seed)
    ]
    right = [trial for trial in trials if trial.success]
    accepted = [trial for trial in trials if trial.converged and not trial.objection]
    return {
        "success %": 100.0 * len(right) / len(trials) if trials else None,
        "error cm": 100.0 * float(np.median([t.error_m for t in right])) if right else None,
        "error deg": float(np.median([t.error_deg for t in right])) if right else None,
        "wrong": sum(not trial.success for trial in accepted),
        "pairs": len(trials),
    }


@functools.lru_cache(maxsize=1)
def methods_of(scene: str, seed: int) -> list[tuple[Pair, Methods]]:
    """Pairs of submaps of a sequence, with the methods that register them."""
    dataset = opened(scene, seed)
    assert dataset.ground_truth is not None
    settings, count = RunSettings(), len(dataset)
    labeller = build_run_labeller(settings, dataset)
    assert labeller is not None
    code = build_code(settings.semantics.code, labeller.taxonomy)
    semantics = build_semantic_mapping(settings.semantics, code, seed)
    describer = build_describer(settings.loops.features)
    frames = [labeller.label(dataset[index]) for index in range(count)]
    recording = Recording(frames, dataset.ground_truth.T_world_camera, semantics)
    generator = np.random.default_rng([seed, 0])
    length = STEP * KEYFRAMES
    starts = [
        *range(0, count // 3 - length, SPACING),
        *range(2 * count // 3, count - length, SPACING),
    ]
    pieces = [
        piece(recording, range(start, start + length, STEP), describer, generator)
        for start in starts
    ]
    pairs = draw_pairs(pieces, PAIRS, semantics, generator, scene, apart=count // 3)
    return [(pair, Methods(pair, seed)) for pair in pairs]


def opened(scene: str, seed: int) -> RecordedDataset:
    """A sequence."""
    return open_dataset("synthetic", room(scene, seed))


if __name__ == "__main__":
    main()
