"""Registration of submaps: success rate, error and time.

python -m benchmarks.registration --rooms 0 1 2 3 4 6 --pairs 34 --frames 150 --size 160 120
SEMSPLAT_DATA=DATA python -m benchmarks.registration --rooms --kitchen --pairs 30
SEMSPLAT_DATA=DATA python -m benchmarks.registration --rooms --kitchen --pairs 30 \\
    --trajectory RUN/trajectory.txt
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.registration_methods import Methods
from benchmarks.registration_pairs import Pair, draw_pairs, kitchen, pool, room
from benchmarks.registration_trials import Trial, judged, tables
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header

KITCHEN_ERROR = 0.02, 1.0  # of RedKitchen's ground truth itself, m and degrees

DESCRIPTION = """\
Submaps are parts of a recording, mapped at their true poses with default settings and described by
the default encoder; the coordinate frame of each is arbitrary, and no frame of the recording is in
both submaps of a pair. Synthetic rooms have their true labels. The ground truth of RedKitchen is
itself accurate to 2 cm and 1 degree only; the table of targets is without and with that error.

Rows with "(start)" begin at the ground truth displaced by up to 0.5 m and 30 degrees, the same for
all; the others have no initial estimate. Success is an error below 5 cm and 2 degrees; the first
two columns are by the overlap of the submaps. "Converged, wrong" counts failures reported as
converged, "passed, wrong" those of them that the verification of loops accepts. Methods take turns
on each pair, so that times are comparable."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure registration."""

    pairs: int = 10
    """Maximum number of pairs of submaps of each recording."""
    rooms: tuple[int, ...] = (0,)
    """Seeds of synthetic rooms."""
    kitchen: bool = False
    """Include the real recording."""
    methods: tuple[str, ...] = ()
    """Rows to measure; the main ones by default. Others are printed, not written."""
    trajectory: Path | None = None
    """Poses of the real recording's frames to use instead of its ground truth (TUM format)."""
    noise: bool = False
    """Render the synthetic rooms with sensor noise."""
    frames: int = 300
    """Frames of a synthetic room; 300 is the whole path."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images in pixels."""
    seed: int = 0
    """Seed of pairs, starts and maps."""
    trials: Path | None = None
    """File for a line of JSON for each result."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure the rooms and the kitchen."""
    options = tyro.cli(Options)
    if options.rooms:
        noise = "-noise" if options.noise else ""
        measure(f"registration-rooms{noise}", room_pairs, options)
    if options.kitchen:
        own = options.trajectory is not None
        name = "registration-redkitchen" + ("-trajectory" if own else "")
        measure(name, kitchen_pairs, options, (0.0, 0.0) if own else KITCHEN_ERROR)


def kitchen_pairs(options: Options) -> list[Pair]:
    """Pairs of the real recording."""
    generator = np.random.default_rng(options.seed)
    recording = kitchen(options.size, options.trajectory)
    pieces = pool(recording, generator)
    return draw_pairs(pieces, options.pairs, recording.semantics, generator, "kitchen")


def room_pairs(options: Options) -> list[Pair]:
    """Pairs of every room."""
    pairs = []
    for seed in tqdm(options.rooms, desc="rooms", file=sys.stderr):
        generator = np.random.default_rng([seed, options.seed])
        recording = room(options.frames, options.size, seed, options.noise)
        pieces = pool(recording, generator)
        pairs += draw_pairs(pieces, options.pairs, recording.semantics, generator, f"room {seed}")
    return pairs


def measure(
    name: str,
    make_pairs: Callable[[Options], list[Pair]],
    options: Options,
    truth_error: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Run every method on every pair and write a row for each method.

    Args:
        truth_error: of the ground truth itself, in metres and degrees.
    """
    header = current_header([options.seed])
    names = options.methods or Methods.MAIN
    trials: list[Trial] = []
    for pair in tqdm(make_pairs(options), desc=name, file=sys.stderr):
        methods = Methods(pair, options.seed)
        for method in names:
            trials.append(judged(method, pair, methods.rows[method]()))
            if options.trials is not None:
                with options.trials.open("a") as file:
                    file.write(json.dumps(vars(trials[-1])) + "\n")
    title = f"Registration of submaps: {name.removeprefix('registration-')}"
    results = Results(name, title, DESCRIPTION, header, tables(trials, truth_error))
    if options.methods:
        print(results.markdown())
    else:
        publish(results, options.out)


if __name__ == "__main__":
    main()
