"""The largest resident memory of every stage of a run, and of the viewer that shows the result.

    SEMSPLAT_DATA=DATA python -m benchmarks.stage_memory

Linux only: the kernel's peak (VmHWM) is reset when a stage begins and read when it ends, so no
short peak is missed. That of a stage includes the stages within it.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.programs import start_semsplat_server
from benchmarks.recordings import RECORDINGS
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import Metrics, table_of
from toolkit.base.options import validated
from toolkit.base.stages import Stage
from toolkit.datasets.registry import open_dataset
from toolkit.runs import results
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
from toolkit.runs.outcome import RunRecord
from toolkit.runs.settings import RunSettings, dump_settings

FRAMES = 200
ROWS: dict[str, dict[str, Any]] = {
    "320x240": {"recording": "redkitchen"},
    "640x480": {"recording": "redkitchen-native"},
}
_WRITING = {
    "evaluation": "evaluate_scene",
    "rendered views": "render_views",
    "report": "report_content",
}
COLUMNS = (
    *("libraries", Stage.FRAME.value, Stage.TRACKING.value, Stage.MAPPING.value),
    *(Stage.LOOP_DETECTION.value, Stage.LOOPS_WITHIN.value, Stage.LOOPS_BETWEEN.value),
    *(Stage.FINISH.value, Stage.MAP_CONSENSUS.value, Stage.HOLE_FILLING.value),
    *(Stage.REFINEMENT.value, *_WRITING, "writing", "viewer"),
)
DESCRIPTION = f"""\
The first {FRAMES} frames of 7-Scenes RedKitchen with default settings, in one process as in
`semsplat run`, then `semsplat view` of the result: the largest resident memory in MB during each
stage, what earlier stages still hold included. `libraries` is the process before the first frame,
`writing` all that follows the refinement."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure the memory of stages."""

    child: str = ""
    """Name of a recording; used by the program itself."""


class PeakRecorder(StageRecorder):
    """A `Recorder` that stores the largest resident memory of each stage of its thread."""

    def __init__(self) -> None:
        super().__init__()
        self.peaks_mb: dict[str, float] = {}
        self._open: list[float] = []  # peaks so far of the stages that are running

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Record the block."""
        self._split()
        self._open.append(0.0)
        try:
            with super().timed(stage):
                yield
        finally:
            self._split()
            peak_mb = self._open.pop()
            self.peaks_mb[str(stage)] = max(self.peaks_mb.get(str(stage), 0.0), peak_mb)

    def _split(self) -> None:
        """Count the memory since the last call for all running stages."""
        peak_mb = _peak_mb("self")
        self._open = [max(peak, peak_mb) for peak in self._open]
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def main() -> None:
    """Measure both sizes."""
    options = tyro.cli(Options)
    if options.child:
        print(json.dumps(measure_here(options.child)))
        return
    report = Report("stage_memory", "The memory of stages", DESCRIPTION, options)
    report.write(table_of(COLUMNS, report.measured(ROWS, measure)))


def measure(job: dict[str, Any], _seed: int) -> Metrics:
    """Peaks by stage, in a process of their own."""
    command = [sys.executable, "-m", "benchmarks.stage_memory", "--child", job["recording"]]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    metrics: Metrics = json.loads(done.stdout.splitlines()[-1])
    return metrics


def measure_here(name: str) -> Metrics:
    """Peaks in MB by stage of a run in this process, and of the viewer."""
    recording, recorder = RECORDINGS[name], PeakRecorder()
    dataset = open_dataset(recording.kind, recording.path, recording.image_size)
    settings = validated(RunSettings, {})
    for stage, function in _WRITING.items():
        _record(recorder, stage, function)
    with tempfile.TemporaryDirectory() as temporary:
        folder = RunFolder.create(Path(temporary) / "run", dump_settings(settings))
        slam = build_slam(dataset, settings, folder, recorder)
        libraries_mb, costs = _peak_mb("self"), FrameCostRecorder(recorder)
        for index in range(min(FRAMES, len(dataset))):
            frame = dataset[index]
            with recorder.timed(Stage.ONLINE), costs.frame(index), recorder.timed(Stage.FRAME):
                slam.process_frame(frame)
        with recorder.timed(Stage.FINISH):
            result = slam.finish()
        folder.check_taxonomy(result.taxonomy)
        with recorder.timed("writing"):
            record = RunRecord(recorder, costs.costs())
            results.write_results(result, dataset, folder, settings, record)
        peaks: Metrics = {**recorder.peaks_mb}
        return peaks | {"libraries": libraries_mb, "viewer": _viewer_mb(folder.path)}


def _record(recorder: PeakRecorder, stage: str, name: str) -> None:
    """Record a function of the results as a stage."""
    function = getattr(results, name)

    def recorded(*arguments: Any, **keywords: Any) -> Any:
        with recorder.timed(stage):
            return function(*arguments, **keywords)

    setattr(results, name, recorded)


def _viewer_mb(run: Path) -> float:
    """Peak of `semsplat view` until its page can be opened."""
    server, address = start_semsplat_server("view", str(run), "--port", "0")
    try:
        urllib.request.urlopen(address).close()
        return _peak_mb(str(server.pid))
    finally:
        server.terminate()
        server.communicate()


def _peak_mb(process: str) -> float:
    """VmHWM of a process, in MB."""
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found is not None
    return int(found[1]) * 1024 / 1e6


if __name__ == "__main__":
    main()
