"""One run of the system, from settings to results, in a folder that is gone afterwards."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from toolkit.datasets.base import Dataset
from toolkit.evaluation.timing import StageRecorder
from toolkit.frame import Frame
from toolkit.loops.log import read_loop_log
from toolkit.runs.building import build_slam
from toolkit.runs.folder import RunFolder
from toolkit.runs.results import write_results
from toolkit.runs.settings import RunSettings, dump_settings
from toolkit.slam import Slam


@dataclass(frozen=True)
class Walk:
    """What a run came to.

    Attributes:
        slam: the finished system.
        metrics: metrics.json. records: loops.jsonl.
        frames_ms: of each frame in turn. finish_s: refinement and fusion.
    """

    slam: Slam
    metrics: dict[str, Any]
    records: list[dict[str, Any]]
    frames_ms: list[float]
    finish_s: float


@contextmanager
def walked(
    settings: RunSettings, dataset: Dataset, prepare: Callable[[Slam], None] | None = None
) -> Iterator[Walk]:
    """Run through a data set, fusion and export included; the folder lives as long as this.

    Args:
        prepare: is given the system before the first frame.
    """
    watch, frames_ms = StageRecorder(), []
    with tempfile.TemporaryDirectory() as made:
        folder = RunFolder.create(Path(made) / "run", dump_settings(settings))
        slam = build_slam(dataset, settings, folder, watch)
        if prepare is not None:
            prepare(slam)
        for index in tqdm(range(len(dataset)), disable=not os.isatty(2), file=sys.stderr):
            frame = dataset[index]
            began = time.perf_counter()
            slam.process_frame(frame)
            frames_ms.append(1e3 * (time.perf_counter() - began))
        began = time.perf_counter()
        slam.finish()
        finish_s = time.perf_counter() - began
        folder.check_taxonomy(slam.taxonomy)
        write_results(slam, dataset, folder, settings, watch)
        metrics = json.loads(folder.metrics.read_text())
        yield Walk(slam, metrics, read_loop_log(folder.loops), frames_ms, finish_s)


class Covered:
    """A data set whose lens is covered from one frame to before another: black, no depth."""

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
