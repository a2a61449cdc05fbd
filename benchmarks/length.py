"""What a longer walk costs: memory, and time a frame from its first quarter to its last.

    python -m benchmarks.length ROOMS HALL [--poses given]

ROOMS and HALL are made by `semsplat make-room --layout rooms --frames 600` and `--layout hall
--frames 2400`, both with `--image-size 160 120 --sensor-noise`: three rooms and twelve. Each
walk is a process of its own, fusion and export included, with a small budget for submaps at
rest so that both fill it. Each quarter is told by its mean: rare steps, such as beginning a
submap, count.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from benchmarks import walks
from benchmarks.machine import describe_machine
from toolkit.datasets.registry import open_dataset
from toolkit.options import validated
from toolkit.runs.settings import RunSettings

COLUMNS = ("ms a frame, quarters", "finish s", "submaps", "lost", "gaussians", "peak_memory_mb")


@dataclass(frozen=True)
class Options:
    """Walk through some rooms, and through more."""

    places: tyro.conf.Positional[tuple[Path, ...]]
    """Data sets, short to long."""
    poses: Literal["slam", "given"] = "slam"
    """Track, or take the truth's."""
    iterations: int = 3
    """Steps a keyframe."""
    memory_mb: float = 50.0
    """Budget of submaps at rest."""
    child: bool = False
    """Walk here and print one line; for the program itself."""


def main() -> None:
    """Print one row a place, and what the last costs beside the first."""
    options = tyro.cli(Options)
    if options.child:
        print(json.dumps(figures(options)))
        return
    print(describe_machine(), flush=True)
    print("\n| | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 1) + "|", flush=True)
    peaks = []
    for place in options.places:
        command = [
            sys.executable,
            "-m",
            "benchmarks.length",
            str(place),
            *sys.argv[1 + len(options.places) :],
        ]
        command += ["--child"]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        print(f"| {place.name} | " + " | ".join(str(row[c]) for c in COLUMNS) + " |", flush=True)
        peaks.append(row["peak_memory_mb"])
    print(f"\nmemory: {peaks[-1] / peaks[0]:.2f} times the first one's", flush=True)


def figures(options: Options) -> dict[str, object]:
    """Figures of one walk."""
    (place,) = options.places
    settings = validated(
        RunSettings,
        {
            "dataset": {"kind": "synthetic", "path": str(place)},
            "poses": options.poses,
            "mapping": {"iterations": options.iterations, "final_iterations": 1},
            "submaps": {"memory_mb": options.memory_mb},
        },
    )
    with walks.walked(settings, open_dataset("synthetic", place)) as walk:
        quarters = [float(np.mean(part)) for part in np.array_split(walk.frames_ms, 4)]
        return walk.metrics | {
            "ms a frame, quarters": " / ".join(f"{ms:.0f}" for ms in quarters),
            "finish s": round(walk.finish_s, 1),
            "submaps": len(walk.slam.atlas),
            "lost": len(walk.slam.lost_frames),
        }


if __name__ == "__main__":
    main()
