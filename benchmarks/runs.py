"""Runs of the system whose results last only as long as they are needed."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.programs import semsplat
from benchmarks.tables import Metrics
from toolkit.base.frame import Frame
from toolkit.base.stages import Stage
from toolkit.datasets.base import Dataset
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
from toolkit.runs.modes import RunInput
from toolkit.runs.outcome import RunRecord
from toolkit.runs.results import write_results
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.slam.loops.log import read_loop_log
from toolkit.slam.result import SlamResult
from toolkit.slam.system import Slam


def run_metrics(arguments: Sequence[str], seed: int) -> Metrics:
    """metrics.json of `semsplat run` in a process of its own, by dotted key.

    Raises:
        SystemExit: the run failed.
    """
    with finished_run(arguments, seed) as (metrics, _):
        return metrics


@contextmanager
def finished_run(arguments: Sequence[str], seed: int) -> Iterator[tuple[Metrics, RunFolder]]:
    """metrics.json by dotted key and the folder of `semsplat run`, within this context.

    Raises:
        SystemExit: the run failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        semsplat("run", *arguments, "--seed", str(seed), "--out", str(out))
        yield flattened(read_metrics(out / "metrics.json")), RunFolder.open(out)


@dataclass(frozen=True)
class FinishedSlam:
    """A run in this process.

    Attributes:
        result: of the finished run.
        metrics: metrics.json by dotted key. records: loops.jsonl.
        frames_ms: processing time of each frame. finish_s: of refinement and fusion.
        memory_mb: resident memory of the process after each frame.
        finished_at_s: of the clock `time.perf_counter`, before evaluation and export.
        results_mb: size of the run folder.
    """

    result: SlamResult
    metrics: Metrics
    records: list[dict[str, Any]]
    frames_ms: list[float]
    finish_s: float
    memory_mb: list[float]
    finished_at_s: float
    results_mb: float


@contextmanager
def finished_slam(
    settings: RunSettings,
    dataset: Dataset,
    prepare: Callable[[Slam], None] | None = None,
    source: RunInput | None = None,
) -> Iterator[FinishedSlam]:
    """Process a dataset and write the results into a folder that exists within this context.

    Args:
        prepare: called with the system before the first frame.
        source: what is processed, without depth; by default the dataset.
    """
    source = source or RunInput(dataset)
    watch = StageRecorder()
    costs = FrameCostRecorder(watch)
    with tempfile.TemporaryDirectory() as temporary:
        folder = RunFolder.create(Path(temporary) / "run", dump_settings(settings))
        slam = build_slam(source.frames, settings, folder, watch, source.correction)
        if prepare is not None:
            prepare(slam)
        for index in tqdm(range(len(dataset)), disable=not os.isatty(2), file=sys.stderr):
            frame = source.frames[index]
            with watch.timed(Stage.ONLINE), costs.frame(index):
                slam.process_frame(frame)
        with watch.timed(Stage.FINISH):
            result = slam.finish()
        finished_at_s = time.perf_counter()
        folder.check_taxonomy(result.taxonomy)
        write_results(result, dataset, folder, settings, RunRecord(watch, costs.costs()))
        slam.atlas.forget_checkpoints()
        slam.atlas.compress()
        metrics = flattened(read_metrics(folder.metrics))
        frames_ms = watch.durations_ms[Stage.ONLINE]
        (finish_ms,) = watch.durations_ms[Stage.FINISH]
        yield FinishedSlam(
            result,
            metrics,
            read_loop_log(folder.loops),
            frames_ms,
            finish_ms / 1e3,
            costs.costs().memory_mb.tolist(),
            finished_at_s,
            sum(f.stat().st_size for f in folder.path.rglob("*") if f.is_file()) / 1e6,
        )


class CoveredLens:
    """A dataset in which the lens is covered for some frames: black images without depth.

    Args:
        first, end: the covered frames, `end` excluded.
    """

    def __init__(self, dataset: Dataset, first: int, end: int) -> None:
        self._dataset, self._covered = dataset, range(first, end)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        frame = self._dataset[index]
        if index not in self._covered:
            return frame
        return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)
