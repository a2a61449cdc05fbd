"""Hashes of the results of short runs, to check that a change of the structure moves no result.

    SEMSPLAT_DATA=DATA python -m benchmarks.fingerprints [--out FILE] [--expected FILE]

Trajectory, map, class tree and metrics without times, sizes of files and conventions are hashed,
each by itself. With `--expected`, the hashes that differ from an earlier output are listed, and the
exit status is 1.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.programs import semsplat
from benchmarks.recordings import sequence_arguments

# Arguments of each run: sequence, and further options.
RUNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "redkitchen": ("redkitchen", ("--max-frames", "40")),
    "fr1_rpy": ("fr1_rpy", ("--max-frames", "40")),
    "office0": ("office0", ("--max-frames", "25")),
    "ring": ("ring-small", ("--max-frames", "90", "--submaps.allocation.max-keyframes", "8")),
    "office0 without depth": ("office0", ("--depth", "none")),
}
_UNSTABLE = ("_ms", "_s", "_mb", "ms_per_frame", "fps", "time", "version", "commit", "convention")


@dataclass(frozen=True)
class Options:
    """Hash the results of short runs."""

    out: Path | None = None
    """JSON file of the hashes."""
    expected: Path | None = None
    """Output of an earlier call, with which the hashes are compared."""


def main() -> None:
    """Run every sequence, and print the hashes."""
    options = tyro.cli(Options)
    found = {name: fingerprint(name) for name in RUNS}
    text = json.dumps(found, indent=1)
    print(text)
    if options.out is not None:
        options.out.write_text(text)
    if options.expected is None:
        return
    expected = json.loads(options.expected.read_text())
    changed = [
        f"{name}: {part}"
        for name, hashes in found.items()
        for part, value in hashes.items()
        if expected.get(name, {}).get(part) != value
    ]
    if changed:
        sys.exit("changed: " + ", ".join(changed))


def fingerprint(name: str) -> dict[str, str]:
    """Hashes of one run's results."""
    sequence, options = RUNS[name]
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "run"
        semsplat("run", *sequence_arguments(sequence), *options, "--out", str(folder))
        metrics = json.loads((folder / "metrics.json").read_text())
        stable = {k: v for k, v in metrics.items() if not any(word in k for word in _UNSTABLE)}
        contents = {
            "trajectory": (folder / "trajectory.txt").read_bytes(),
            "map": (folder / "map.ply").read_bytes(),
            "metrics": json.dumps(stable, sort_keys=True).encode(),
        }
    return {part: hashlib.sha256(content).hexdigest()[:16] for part, content in contents.items()}


if __name__ == "__main__":
    main()
