"""Recordings as people have them: what an earlier commit and this one make of each kind.

    python -m benchmarks.inputs [--commit 1a8233b1]

Every input is made on the spot (`input_kinds`). The earlier commit is compiled in a temporary
folder.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.earlier_commit import earlier_tree
from benchmarks.input_kinds import FRAMES, KINDS, Kind, write_room
from benchmarks.programs import semsplat_of
from benchmarks.report import Report, ReportOptions
from benchmarks.repository import ROOT
from benchmarks.tables import Metrics, Table
from toolkit.runs.evaluation.metrics import flattened, read_metrics

DESCRIPTION = """\
A synthetic room ({frames} frames, 160x120) in the form of each kind of recording, given to the
commit {commit} (before) and to this one (now). Good maps have the PSNR of their mapped views, the
ATE relative to the size of the scene, and lost frames; otherwise, the last line of the message.
"reported" marks runs that report a defect of the data, "worse than its images allow" those that
say so of the map."""
_MAX_MESSAGE = 160


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Give recordings of every kind to an earlier commit and to this one."""

    commit: str = "1a8233b1"
    """The earlier commit."""


def main() -> None:
    """Measure all kinds with both commits."""
    options = tyro.cli(Options)
    description = DESCRIPTION.format(frames=FRAMES, commit=options.commit)
    report = Report("inputs", "Recordings as people have them", description, options)
    jobs = {name: {"kind": name, "commit": options.commit} for name in KINDS}
    with earlier_tree(options.commit) as tree:
        rows = report.measured(jobs, lambda job, _: outcomes(tree, job))
    cells = [
        (name, KINDS[name].right, str(metrics["before"]), str(metrics["now"]))
        for name, (metrics,) in rows.items()
    ]
    report.write(Table(("input", "right", "before", "now"), tuple(cells)))


def outcomes(earlier: Path, job: Mapping[str, Any]) -> Metrics:
    """What an earlier tree and this one make of a kind."""
    kind = KINDS[job["kind"]]
    return {"before": outcome(earlier, kind), "now": outcome(ROOT, kind)}


def outcome(tree: Path, kind: Kind) -> str:
    """One line about what a tree makes of a kind."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary) / "mine", Path(temporary) / "out"
        write_room(folder, kind.change)
        kind.after(folder)
        words = [word.replace("FOLDER", str(folder)) for word in kind.job]
        if words[0] != "check-data":
            words += ["--out", str(out)]
        done = semsplat_of(tree, *words)
        metrics = out / "metrics.json"
        if done.returncode == 0 and metrics.exists():
            return _map_line(flattened(read_metrics(metrics)), kind, done.stderr)
        lines = (done.stdout + done.stderr).strip().splitlines() or [""]
        message = lines[-1].replace(str(Path(temporary)), "").removeprefix("semsplat: error: ")
        short = message if len(message) <= _MAX_MESSAGE else message[: _MAX_MESSAGE - 3] + "..."
        return f"status {done.returncode}: {short}".replace("|", "/")


def _map_line(metrics: Mapping[str, Any], kind: Kind, log: str) -> str:
    ate_cm, psnr_db = metrics["trajectory.ate_rmse_cm"], metrics["images.mapped.psnr_db"]
    ate = "" if ate_cm is None else f", ATE {ate_cm / kind.scale:.2f} cm"
    lost = metrics["frames.lost"] + (metrics.get("frames.doubtful") or 0)
    psnr = "no view" if psnr_db is None else f"{psnr_db:.1f} dB"
    words = (
        "agree",
        "shifted relative",
        "contradict",
        "count as missing",
        "interpolated",
        "jump",
        "refined",
        "declared as",
        "of the images is up",
    )
    reported = ", reported" if any(word in log for word in words) else ""
    worse = ", worse than its images allow" if "worse than its images" in log else ""
    return f"{psnr}{ate}, {lost} lost or doubtful{reported}{worse}"


if __name__ == "__main__":
    main()
