"""Runs of the system whose results last only as long as they are needed."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.shared.programs import semsplat
from benchmarks.shared.tables import Metrics
from toolkit.base.stages import Stage
from toolkit.datasets.base import Dataset
from toolkit.runs.building import build_slam
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
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
        path: of the run folder.
        result: of the finished run. watch: with the times of its stages.
        metrics: metrics.json by dotted key. records: loops.jsonl.
    """

    path: Path
    result: SlamResult
    watch: StageRecorder
    metrics: Metrics
    records: list[dict[str, Any]]


@contextmanager
def finished_slam(
    settings: RunSettings,
    dataset: Dataset,
    prepare: Callable[[Slam], None] | None = None,
) -> Iterator[FinishedSlam]:
    """Process a dataset and write the results into a folder that exists within this context.

    Args:
        prepare: called with the system before the first frame.
    """
    watch = StageRecorder()
    costs = FrameCostRecorder(watch)
    with tempfile.TemporaryDirectory() as temporary:
        folder = RunFolder.create(Path(temporary) / "run", dump_settings(settings))
        slam = build_slam(dataset, settings, folder, watch)
        if prepare is not None:
            prepare(slam)
        for index in tqdm(range(len(dataset)), disable=not os.isatty(2), file=sys.stderr):
            frame = dataset[index]
            with watch.timed(Stage.ONLINE), costs.frame(index):
                slam.process_frame(frame)
        with watch.timed(Stage.FINISH):
            result = slam.finish()
        folder.check_taxonomy(result.taxonomy)
        write_results(result, dataset, folder, settings, RunRecord(watch, costs.costs()))
        metrics = flattened(read_metrics(folder.metrics))
        yield FinishedSlam(folder.path, result, watch, metrics, read_loop_log(folder.loops))
