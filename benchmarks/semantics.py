"""What semantics cost and what they are worth, code by code.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics cost quality noise ablation room \
        [--room DIR]

Each part prints a table; each run is a process of its own with the default settings but for
what its row names. `quality`, `noise` and `ablation` map replica_office0 with its poses
given and every fifth view held back; `room` tracks and maps a synthetic room (`semsplat
make-room --out DIR`); `cost` times one mapping step on a map of replica_office0, codes in turn.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from benchmarks.machine import describe_machine
from toolkit.datasets.registry import open_dataset
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe
from toolkit.mapping.consensus import segments_of
from toolkit.mapping.factory import build_mapper, build_semantic_mapping
from toolkit.mapping.mapper import Mapper
from toolkit.options import validated
from toolkit.rendering import backend
from toolkit.runs.settings import RunSettings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import shipped_taxonomy

Part = Literal["cost", "quality", "noise", "ablation", "room"]
CODES = ("none", "flat", "one-hot", "binary")
GEOMETRY = ("ate_rmse_cm", "psnr_db", "psnr_unseen_db", "ssim", "depth_l1_cm")
SEMANTIC = ("miou_percent", "miou_unseen_percent", "miou_level_0_percent", "ece_percent")
COSTS = (
    "tracking_ms_per_frame",
    "labelling_ms_per_frame",
    "mapping_ms_per_frame",
    "refinement_ms_per_frame",
    "map_mb",
    "peak_memory_mb",
)
WRONG_SHARE = 0.2  # of the segments of each frame


@dataclass(frozen=True)
class Options:
    """Measure semantics."""

    parts: tyro.conf.Positional[tuple[Part, ...]] = ("cost", "quality", "noise")
    room: Path | None = None
    """A noise-free synthetic room, for the part `room`."""
    seeds: int = 1
    """Seeds 0, 1, ...; a row is their median."""
    rounds: int = 15
    """Timed steps of each code, for the part `cost`."""


@dataclass(frozen=True)
class Table:
    """Rows of options, and the columns of metrics.json that are shown."""

    columns: tuple[str, ...]
    rows: dict[str, list[str]] = field(default_factory=dict)


def main() -> None:
    """Print the tables that were asked for."""
    options = tyro.cli(Options)
    print(describe_machine(), flush=True)
    parts: dict[Part, Callable[[Options], None]] = {
        "cost": cost,
        "quality": quality,
        "noise": noise,
        "ablation": ablation,
        "room": room,
    }
    for part in options.parts:
        print(f"\n### {part}", flush=True)
        parts[part](options)


def office() -> list[str]:
    """Options of a run on replica_office0 with given poses and held-out views."""
    path = Path(os.environ["SEMSPLAT_DATA"]) / "replica_office0"
    place = ["--dataset.kind", "replica", "--dataset.path", str(path)]
    return [*place, "--poses", "given", "--hold-out", "5"]


def code(kind: str) -> list[str]:
    return ["--semantics.code.kind", kind]


def quality(options: Options) -> None:
    """Codes on the same views: geometry must not suffer, labels must be right."""
    show(
        Table(
            (*GEOMETRY[1:], *SEMANTIC, "miou_level_0_unseen_percent", *COSTS[2:]),
            {kind: [*office(), *code(kind)] for kind in (*CODES, "colour")},
        ),
        options,
    )


def room(options: Options) -> None:
    """Codes on a synthetic room, tracked and mapped."""
    if options.room is None:
        raise SystemExit("--room DIR is needed; make one with: semsplat make-room --out DIR")
    place = ["--dataset.kind", "synthetic", "--dataset.path", str(options.room)]
    rows = {kind: [*place, *code(kind)] for kind in CODES}
    columns = (*GEOMETRY, *SEMANTIC, "miou_unseen_refined_percent", "classes_scored", *COSTS)
    show(Table(columns, rows), options)


def noise(options: Options) -> None:
    """A share of the segments of every frame with a wrong class."""
    with tempfile.TemporaryDirectory() as folder:
        write_wrong_labels(Path(folder), np.random.default_rng(0))
        wrong = [
            *("--semantics.segmenter.kind", "images"),
            *("--semantics.segmenter.images.folder", folder),
            *("--semantics.segmenter.images.pairing", "number"),
        ]
        rounds = "--mapping.consensus.rounds"
        rows = {
            "20 % wrong": [*office(), *wrong],
            "20 % wrong, votes alone": [*office(), *wrong, rounds, "0"],
            "20 % wrong, binary": [*office(), *wrong, *code("binary")],
        }
        show(Table(SEMANTIC, rows), options)


def ablation(options: Options) -> None:
    """Terms of the loss, ways to read the code, ways to seed."""
    network = ["--semantics.network.use"]
    share = ["--mapping.seeding.share", "0.35", "--mapping.seeding.choice"]
    rows = {
        "intra + inter, by path": [*office(), *network],
        "intra + inter, by network": [*office(), *network, "--semantics.reader", "network"],
        "geometry moved by semantics": [*office(), "--semantics.loss.moves-geometry"],
        "35 % of pixels seed, uniform": [*office(), *share, "uniform"],
        "35 % of pixels seed, semantic": [*office(), *share, "semantic"],
    }
    columns = ("psnr_db", "psnr_unseen_db", *SEMANTIC, "gaussians", *COSTS[2:4])
    show(Table(columns, rows), options)


def write_wrong_labels(folder: Path, generator: np.random.Generator) -> None:
    """The labels of replica_office0 with a share of each frame's segments renamed."""
    source = Path(os.environ["SEMSPLAT_DATA"]) / "replica_office0" / "labels"
    shutil.copy(source / "classes.json", folder)
    files = sorted(source.glob("label*.png"))
    images = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
    present = np.unique(np.concatenate([np.unique(image) for image in images]))
    present = present[present > 0]
    for file, image in zip(files, images, strict=True):
        cv2.imwrite(str(folder / file.name), renamed(image, present, generator))


def renamed(
    labels: NDArray[np.integer], present: NDArray[np.integer], generator: np.random.Generator
) -> NDArray[np.integer]:
    """A label image with WRONG_SHARE of its segments given another class of the sequence."""
    segments, own = segments_of(labels)
    wrong = (generator.random(len(own)) < WRONG_SHARE) & (own > 0)
    shift = generator.integers(1, len(present), len(own))
    place = (np.searchsorted(present, own) + shift) % len(present)
    return np.where(wrong, present[place], own)[segments].astype(labels.dtype)


def show(table: Table, options: Options) -> None:
    """Run the rows of a table and print it."""
    print("| | " + " | ".join(table.columns) + " |")
    print("|---" * (len(table.columns) + 1) + "|", flush=True)
    for name, arguments in table.rows.items():
        runs = [run(arguments, seed) for seed in range(options.seeds)]
        cells = [_median([metrics.get(column) for metrics in runs]) for column in table.columns]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def run(arguments: list[str], seed: int) -> dict:
    """metrics.json of `semsplat run`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "toolkit.cli.main", "run", *arguments]
        command += ["--seed", str(seed), "--out", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")
        return json.loads((out / "metrics.json").read_text())


def _median(values: list) -> str:
    if any(value is None for value in values):
        return ""
    middle = statistics.median(values)
    return str(middle) if isinstance(middle, int) else f"{middle:.4g}"


def cost(options: Options) -> None:
    """One step by code on the same map and view, taking turns so that noise hits all alike."""
    subjects = {name: Subject(name, kind, inter) for name, kind, inter in SUBJECTS}
    times: dict[str, dict[str, list[float]]] = {name: {} for name in subjects}
    for turn in range(options.rounds + 1):
        for name, subject in subjects.items():
            for stage, seconds in subject.step().items():
                if turn:
                    times[name].setdefault(stage, []).append(1e3 * seconds)
    stages = ("forward", "backward", "renderer", "step")
    print("| | channels | map MB | " + " | ".join(f"{s} ms | of flat" for s in stages) + " |")
    print("|---" * (3 + 2 * len(stages)) + "|")
    medians = {n: {s: statistics.median(t[s]) for s in stages} for n, t in times.items()}
    for name, subject in subjects.items():
        flat = medians["flat, inter sampled" if "inter" in name else "flat"]
        cells = [f"{medians[name][s]:.1f} | {medians[name][s] / flat[s]:.2f}" for s in stages]
        print(f"| {name} | {subject.channels} | {subject.map_mb:.1f} | " + " | ".join(cells) + " |")


SUBJECTS = (
    ("none", "none", None),
    ("flat", "flat", None),
    ("one-hot", "one-hot", None),
    ("binary", "binary", None),
    ("flat, inter sampled", "flat", 2048),
    ("one-hot, inter sampled", "one-hot", 2048),
    ("binary, inter sampled", "binary", 2048),
    ("flat, inter on all", "flat", 0),
    ("one-hot, inter on all", "one-hot", 0),
    ("binary, inter on all", "binary", 0),
)


class Subject:
    """A map of one view of replica_office0 under one code.

    Args:
        inter: pixels of the inter-level term, 0 for all, None without the term.
    """

    def __init__(self, name: str, kind: str, inter: int | None) -> None:
        self.name = name
        path = Path(os.environ["SEMSPLAT_DATA"]) / "replica_office0"
        dataset = open_dataset("replica", path, None, 1)
        taxonomy = shipped_taxonomy("replica")
        settings = validated(
            RunSettings,
            {
                "mapping": {"first_iterations": 1, "seeding": {"largest_cell": 1}},
                "semantics": {
                    "code": {"kind": kind},
                    "loss": {"inter_pixels": inter or 0, "inter_from": 0},
                    "network": {"use": inter is not None},
                },
            },
        )
        self._mapper = self._build(settings, taxonomy)
        self._mapper.add_keyframe(Keyframe.from_frame(dataset[0], np.eye(4)))
        self.channels = 4 + self._mapper.semantics.channels
        cloud = self._mapper.gaussians
        self.map_mb = len(cloud) * (8 + self._mapper.semantics.channels) * 4 / 1e6

    @staticmethod
    def _build(settings: RunSettings, taxonomy: Taxonomy) -> Mapper:
        chosen = build_code(settings.semantics.code, taxonomy)
        semantics = build_semantic_mapping(settings.semantics, chosen, 0)
        generator = np.random.default_rng(0)
        return build_mapper(settings.mapping, generator, "auto", None, semantics)

    def step(self) -> dict[str, float]:
        """Seconds of the renderer's two passes, alone, and of a whole mapping step."""
        mapper = self._mapper
        cloud, keyframe = mapper.gaussians, mapper.keyframes[0]
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        times = {}
        start = time.perf_counter()
        drawn = backend().forward(cloud, keyframe.camera, T_camera_map, cloud.features, None)
        times["forward"] = time.perf_counter() - start
        gradient = torch.ones_like(drawn.images)
        start = time.perf_counter()
        drawn.backward(gradient)
        times["backward"] = time.perf_counter() - start
        times["renderer"] = times["forward"] + times["backward"]
        del drawn
        start = time.perf_counter()
        mapper._step(keyframe, (0, 4))  # of a call's steps one with semantics
        times["step"] = time.perf_counter() - start
        return times


if __name__ == "__main__":
    main()
