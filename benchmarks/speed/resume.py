"""Kills runs at random moments, resumes them, and compares the results with an uninterrupted run.

python -m benchmarks.speed.resume
python -m benchmarks.speed.resume --frames 150 "--extra=--image-size 160 120"
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.shared.programs import semsplat, start_semsplat
from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import Table
from toolkit.runs.evaluation.metrics import flattened, read_metrics

SAME_BYTES = ("trajectory.txt", "map.ply", "loops.jsonl", "frames.json", "config.yaml")
DIFFERENT_EACH_TIME = ("_ms_per_frame", "memory.peak_mb")


DESCRIPTION = """\
`semsplat run` on the synthetic room is killed (SIGKILL) at random moments and resumed with
`--resume`. `trajectory.txt`, `map.ply`, `loops.jsonl`, `frames.json` and `config.yaml` are compared
byte by byte, `metrics.json` except for times and memory."""


@dataclass(frozen=True)
class Options:
    """Kill and resume."""

    kills: int = 10
    """Number of interrupted runs."""
    frames: int = 60
    """Frames of each run."""
    seed: int = 0
    """Seed of the moments."""
    extra: str = ""
    """Further options of every run, in one string."""
    out: Path = RESULTS
    """Folder of the results file."""


def main() -> int:
    """Measure one row for each killed run; exit with 1 if any differs."""
    options = tyro.cli(Options)
    header = current_header([0], ("toolkit",))
    moments = random.Random(options.seed)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole"
        begin = time.monotonic()
        semsplat(*_words(options, whole))
        length_s = time.monotonic() - begin
        for number in range(options.kills):
            out = Path(folder) / f"killed{number}"
            after_s = moments.uniform(0.15, 0.95) * length_s
            at_frame = _run_killed(_words(options, out), out, after_s)
            begun = (out / "config.yaml").exists()  # not killed before the run folder was made
            semsplat(*_words(options, out), *(["--resume"] if begun else []))
            different = _differences(whole, out)
            verdict = f"**differs** in {', '.join(different)}" if different else "identical"
            rows.append((str(number), f"{after_s:.1f}", at_frame, verdict))
    table = Table(("run", "killed after s", "checkpoint at frame", "result"), tuple(rows))
    publish(Results("resume", "Kill and resume", DESCRIPTION, header, (table,)), options.out)
    return 1 if any(row[-1] != "identical" for row in rows) else 0


def _words(options: Options, out: Path) -> list[str]:
    words = ["run", "--out", str(out), *sequence_arguments("room")]
    words += ["--max-frames", str(options.frames), "--checkpoint.every-s", "1"]
    return [*words, *options.extra.split()]


def _run_killed(words: list[str], out: Path, after_s: float) -> str:
    process = start_semsplat(*words)
    time.sleep(after_s)
    process.kill()
    process.wait()
    frames = [
        json.loads(path.read_text())["next_frame"]
        for path in (out / "checkpoint").glob("*/metadata.json")
    ]
    return str(max(frames)) if frames else "none"


def _differences(whole: Path, resumed: Path) -> list[str]:
    names = [n for n in SAME_BYTES if (whole / n).read_bytes() != (resumed / n).read_bytes()]
    if _lasting(whole) != _lasting(resumed):
        names.append("metrics.json")
    return names


def _lasting(run: Path) -> dict[str, object]:
    metrics = flattened(read_metrics(run / "metrics.json"))
    return {k: v for k, v in metrics.items() if not k.endswith(DIFFERENT_EACH_TIME)}


if __name__ == "__main__":
    sys.exit(main())
