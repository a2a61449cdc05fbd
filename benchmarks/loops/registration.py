"""Registration of submaps: success rate, error and time.

    python -m benchmarks.loops.registration --rooms 0 1 2 3 4 6 --pairs 34 --frames 150 \\
        --size 160 120
    SEMSPLAT_DATA=DATA python -m benchmarks.loops.registration --rooms --kitchen --pairs 30
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.loops.registration_methods import Methods
from benchmarks.loops.registration_pairs import Pair, Recording, draw_pairs, kitchen, pool, room
from benchmarks.loops.registration_trials import Trial, judged, tables
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish

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
    noise: bool = False
    """Render the synthetic rooms with sensor noise."""
    frames: int = 300
    """Frames of a synthetic room; 300 is the whole path."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the images in pixels."""
    seed: int = 0
    """Seed of pairs, starts and maps."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> None:
    """Measure the rooms and the kitchen."""
    options = tyro.cli(Options)
    if options.rooms:
        pairs = []
        for seed in tqdm(options.rooms, desc="rooms", file=sys.stderr):
            recording = room(options.frames, options.size, seed, options.noise)
            generator = np.random.default_rng([seed, options.seed])
            pairs += _pairs(recording, f"room {seed}", generator, options)
        measure(f"rooms{'-noise' if options.noise else ''}", pairs, options)
    if options.kitchen:
        generator = np.random.default_rng(options.seed)
        pairs = _pairs(kitchen(options.size), "kitchen", generator, options)
        measure("redkitchen", pairs, options, KITCHEN_ERROR)


def _pairs(
    recording: Recording, name: str, generator: np.random.Generator, options: Options
) -> list[Pair]:
    pieces = pool(recording, generator)
    return draw_pairs(pieces, options.pairs, recording.semantics, generator, name)


def measure(
    name: str, pairs: list[Pair], options: Options, truth_error: tuple[float, float] = (0.0, 0.0)
) -> None:
    """Run every method on every pair and write a row for each method.

    Args:
        truth_error: of the ground truth itself, in metres and degrees.
    """
    header = current_header([options.seed])
    trials: list[Trial] = []
    for pair in tqdm(pairs, desc=name, file=sys.stderr):
        methods = Methods(pair, options.seed)
        trials += [judged(method, pair, methods.rows[method]()) for method in Methods.MAIN]
    title = f"Registration of submaps: {name}"
    found = tables(trials, truth_error)
    publish(Results(f"registration-{name}", title, DESCRIPTION, header, found), options.out)


if __name__ == "__main__":
    main()
