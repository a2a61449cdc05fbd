"""What a frame's time consists of, how many cores each part uses, and a picture of some frames.

    SEMSPLAT_DATA=DATA python -m benchmarks.timeline

The run is the pipeline of `semsplat run`, with frames read and filtered in advance, in a process of
its own that uses all cores.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import tyro

from benchmarks.recordings import RECORDINGS
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import Metrics, table_of
from toolkit.base.options import validated
from toolkit.base.stages import Stage
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.settings import RunSettings

FRAMES, _SHOWN, _WARM = 80, 7, 30
ROWS: dict[str, dict[str, Any]] = {
    f"{title}{', AVX2' * (isa == 'avx2')}, {kind}": {"recording": name, "row": kind, "isa": isa}
    for title, name in (("320x240", "redkitchen"), ("640x480", "redkitchen-native"))
    for isa in ("", "avx2")
    for kind in ("ms per frame", "cores")
}
# Stages of the loop over frames, innermost ones where they are nested.
STAGES = (
    *(Stage.DENOISING, Stage.TRACKING_RENDER, Stage.TRACKING_ALIGN, Stage.TRACKING_EVIDENCE),
    *(Stage.EXPOSURE, Stage.FREE_SPACE, Stage.SEEDING),
    *(Stage.MAP_FORWARD, Stage.MAP_LOSS, Stage.MAP_BACKWARD, Stage.MAP_UPDATE),
    Stage.LOOP_DETECTION,
)
COLUMNS = (Stage.FRAME.value, *(stage.value for stage in STAGES), "rest", "waiting for frames")
DESCRIPTION = f"""\
Frames {_WARM} to {FRAMES} of 7-Scenes RedKitchen with default settings, in milliseconds of
wall-clock time per frame, and the cores that the process used meanwhile: processor time over
wall-clock time, that of the thread that reads and filters later frames included. `rest` is the
time of a frame outside of the named stages. Rows without an instruction set used the best one of
the machine. The [picture](timeline.svg) shows {_SHOWN} frames:
each stage in the thread that ran it."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure where the time of a frame goes."""

    child: str = ""
    """Name of a recording; used by the program itself."""


@dataclass(frozen=True)
class Span:
    """A stage: when it began and ended, in seconds, and processor time meanwhile."""

    stage: str
    start_s: float
    end_s: float
    processor_s: float
    thread: str


class SpanRecorder(StageRecorder):
    """A `Recorder` that stores when each stage ran, and in which thread."""

    def __init__(self) -> None:
        super().__init__()
        self.spans: list[Span] = []

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Record the block."""
        start_s, used_s = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            end_s, thread = time.perf_counter(), threading.current_thread().name
            used_s = time.process_time() - used_s
            self.spans.append(Span(str(stage), start_s, end_s, used_s, thread))


def main() -> None:
    """Measure both sizes, and draw the larger one."""
    options = tyro.cli(Options)
    if options.child:
        print(json.dumps([vars(span) for span in spans_of(options.child)]))
        return
    report = Report("timeline", "The time of a frame", DESCRIPTION, options)
    report.write(table_of(COLUMNS, report.measured(ROWS, measure)))
    name = "redkitchen-native"
    draw(_spans(name), options.out / "timeline.svg")


def measure(job: dict[str, Any], _seed: int) -> Metrics:
    """Milliseconds per frame or cores by stage."""
    spans = _spans(job["recording"], job["isa"])
    wall: dict[str, float] = defaultdict(float)
    used: dict[str, float] = defaultdict(float)
    for span in spans:
        wall[span.stage] += span.end_s - span.start_s
        used[span.stage] += span.processor_s
    for total in (wall, used):
        total["rest"] = total[Stage.FRAME] - sum(total[stage] for stage in STAGES)
    count = sum(span.stage == Stage.FRAME for span in spans)
    if job["row"] == "cores":
        return {name: used[name] / wall[name] for name in COLUMNS if wall[name] > 0}
    return {name: 1e3 * wall[name] / count for name in COLUMNS}


@cache
def _spans(recording: str, isa: str = "") -> list[Span]:
    """The spans of a run in a process of its own, which uses all cores.

    Args:
        isa: instruction set of the kernels; the best one of the machine if empty.
    """
    environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
    if isa:
        environment["SEMSPLAT_ISA"] = isa
    command = [sys.executable, "-m", "benchmarks.timeline", "--child", recording]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, env=environment)
    return [Span(**values) for values in json.loads(done.stdout.splitlines()[-1])]


def spans_of(name: str) -> list[Span]:
    """Process a recording in this process; the spans after the first frames."""
    recording, recorder = RECORDINGS[name], SpanRecorder()
    dataset = open_dataset(recording.kind, recording.path, recording.image_size)
    slam = build_slam(dataset, validated(RunSettings, {}), recorder=recorder)
    frames = prefetched(dataset, range(FRAMES), prepare=slam.prepare)
    while True:
        with recorder.timed("waiting for frames"):
            frame = next(frames, None)
        if frame is None:
            break
        with recorder.timed(Stage.FRAME):
            slam.process_frame(frame)
    starts = [span.start_s for span in recorder.spans if span.stage == Stage.FRAME]
    return [span for span in recorder.spans if span.start_s >= starts[_WARM]]


def draw(spans: list[Span], path: Path) -> None:
    """Draw the first frames: a row for each thread, stages in it by their depth."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams["svg.hashsalt"] = "timeline"
    frames = sorted(s.start_s for s in spans if s.stage == Stage.FRAME)
    begin_s, end_s = frames[0], frames[_SHOWN]
    shown = [s for s in spans if begin_s <= s.start_s < end_s]
    named = [name for name in COLUMNS[1:-2] if any(s.stage == name for s in shown)]
    colours = dict(zip(named, mpl.colormaps["tab20"].colors, strict=False))  # type: ignore[attr-defined]
    threads = sorted({s.thread for s in shown}, key=lambda name: name != "MainThread")
    figure = Figure(figsize=(11, 1.2 + 0.6 * len(threads)), layout="constrained")
    axes = figure.add_subplot()
    for span in shown:
        row, length = -threads.index(span.thread), 1e3 * (span.end_s - span.start_s)
        place = 1e3 * (span.start_s - begin_s)
        if span.stage == Stage.FRAME:
            axes.barh(row, length, 0.8, place, color="#e8e8e8", edgecolor="#666666", linewidth=0.5)
        elif span.stage in colours:
            axes.barh(row, length, 0.6, place, color=colours[span.stage])
    for name, colour in colours.items():
        axes.barh(0, 0, color=colour, label=name)
    axes.set_yticks([-k for k in range(len(threads))], threads)
    axes.set_xlabel("ms")
    axes.set_xlim(0, 1e3 * (end_s - begin_s))
    figure.legend(loc="outside upper center", ncols=6, fontsize=8, frameon=False)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
