"""Time and memory of runs with and without instances."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from benchmarks.shared.runs import run_metrics
from benchmarks.shared.tables import Metrics
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings
from toolkit.scene.instances.options import InstanceOptions

OFF = "off"
_FRAMES = 60
COST_COLUMNS = ("ms_per_frame", "more_percent", "finish_s", "peak_mb", "more_mb_percent")
COST_NOTE = """\
CPU time per frame of three systems that take turns with every frame, and of the end of the run,
which is not a part of it; peak memory of `semsplat run` in a process of its own. "More" is relative
to instances that are off. Folder: true masks. The first 60 frames, with sensor noise."""


def measure_costs(path: Path, seed: int) -> dict[str, Metrics]:
    """Metrics by the kind of instances.

    Args:
        path: folder of a synthetic room.
        seed: of the runs.
    """
    options = {
        OFF: InstanceOptions(),
        "folder": InstanceOptions("folder", path / "instances"),
        "geometric": InstanceOptions("geometric"),
    }
    dataset = open_dataset("synthetic", path)
    settings = RunSettings(dataset=DatasetOptions(kind="synthetic", path=path), seed=seed)
    systems = {k: build_slam(dataset, replace(settings, instances=o)) for k, o in options.items()}
    spent, ends = dict.fromkeys(systems, 0.0), dict.fromkeys(systems, 0.0)
    kinds = list(systems)
    frames = min(len(dataset), _FRAMES)
    for index in range(frames):
        frame = dataset[index]
        for turn in range(len(kinds)):
            kind = kinds[(index + turn) % len(kinds)]
            begin = time.process_time()
            systems[kind].process_frame(frame)
            spent[kind] += time.process_time() - begin
    for kind, slam in systems.items():
        begin = time.process_time()
        slam.finish()
        ends[kind] = time.process_time() - begin
    memory = {kind: _peak_mb(path, one, seed) for kind, one in options.items()}
    return {
        kind: {
            "ms_per_frame": 1000.0 * spent[kind] / frames,
            "more_percent": 100.0 * (spent[kind] / spent[OFF] - 1.0),
            "finish_s": ends[kind],
            "peak_mb": memory[kind],
            "more_mb_percent": 100.0 * (memory[kind] / memory[OFF] - 1.0),
        }
        for kind in kinds
    }


def _peak_mb(path: Path, options: InstanceOptions, seed: int) -> float:
    words = ["--dataset.kind", "synthetic", "--dataset.path", str(path)]
    words += ["--max-frames", str(_FRAMES), "--instances.kind", options.kind]
    words += [] if options.path is None else ["--instances.path", str(options.path)]
    return float(run_metrics(words, seed)["memory.peak_mb"])
