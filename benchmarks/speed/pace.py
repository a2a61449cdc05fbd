"""`semsplat run --pace`: delay of the poses, accuracy, and quality before and after refinement.

    SEMSPLAT_DATA=DATA python -m benchmarks.speed.pace [--only NAMES]

Run it on an idle machine: the results depend on the time that the machine has for each frame.
"""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np

from benchmarks.shared.recordings import sequence_arguments
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import finished_run
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from toolkit.datasets.registry import open_dataset
from toolkit.runs.building import build_slam
from toolkit.runs.folder import RunFolder
from toolkit.runs.outcome import tracked_frames
from toolkit.runs.scoring import evaluate_scene
from toolkit.runs.settings import load_settings

COLUMNS = (
    *("pace.fps", "trajectory.ate_rmse_cm", "psnr_before_refinement_db"),
    *("images.mapped.psnr_db", "images.unseen_refined.psnr_db", "pace.delay_median_ms"),
    *("pace.delay_p95_ms", "pace.delay_max_ms", "pace.delay_bound_ms", "frames.total"),
    *("pace.frames_dropped", "pace.frames_late", "frames.lost", "frames.keyframes"),
    *("pace.keyframes_thinned", "pace.mapping_steps_due", "pace.mapping_steps_deferred"),
    *("pace.mapping_steps_skipped", "time.refinement_ms_per_frame"),
)
ROWS: dict[str, list[str]] = {
    "RedKitchen, offline": ["redkitchen"],
    "RedKitchen, 15 per second": ["redkitchen", "--pace", "15"],
    "room, offline": ["room"],
    "room, 30 per second": ["room", "--pace", "30"],
}
_PARTS = 10
DESCRIPTION = f"""\
`semsplat run` offline and with `--pace`, where frames arrive at camera rate and mapping uses the
time that remains. RedKitchen and the synthetic room have 320x240 pixels. The delay is the time from
the arrival of a frame to its pose. All frames are scored, dropped ones at the last pose before
them. PSNR is the mean over at most 100 views of the recording; before the final refinement, it is
that of the same run, fused without the optimisation steps of the refinement. Runs with `--pace`
depend on the speed of the machine and are not reproducible. The second table divides each sequence
into {_PARTS} parts of equal length: median and maximum of the delay in ms, and dropped frames."""


def measure(job: list[str], seed: int) -> Metrics:
    """Run one sequence; the delays are part of the metrics."""
    sequence, *options = job
    with finished_run([*sequence_arguments(sequence), *options], seed) as (metrics, folder):
        if folder.delays.exists():
            with folder.delays.open(encoding="utf-8") as file:
                delays_s = [row["delay_s"] for row in csv.DictReader(file)]
            # A dropped frame has none.
            metrics["delays_ms"] = [1e3 * float(delay) if delay else None for delay in delays_s]
        return metrics | {"psnr_before_refinement_db": _psnr_before_refinement(folder)}


def _psnr_before_refinement(folder: RunFolder) -> float | None:
    """PSNR of the map as it was after the last frame, which a checkpoint holds; overwrites it."""
    settings = load_settings(folder.config)
    source = settings.dataset
    assert source.path is not None
    dataset = open_dataset(source.kind, source.path, settings.image_size, settings.max_frames)
    mapping = replace(settings.mapping, final_iterations=0)
    slam = build_slam(dataset, replace(settings, mapping=mapping), folder)
    checkpoint = folder.checkpoints.load()
    assert checkpoint is not None
    slam.restore(checkpoint.arrays, checkpoint.values)
    result = slam.finish()
    tracked = tracked_frames(result, settings)
    value = evaluate_scene(result.map, tracked, dataset, settings)["images"]["mapped"]["psnr_db"]
    return None if value is None else float(value)


def tables(rows: Rows) -> list[Table]:
    """All rows, and the delays in each part of the sequences."""
    parts: dict[str, Metrics] = {str(part + 1): {} for part in range(_PARTS)}
    names = [name for name, (run,) in rows.items() if "delays_ms" in run]
    for name in names:
        delays_ms = np.array(rows[name][0]["delays_ms"], np.float64)
        for own, cells in zip(np.array_split(delays_ms, _PARTS), parts.values(), strict=True):
            known = own[np.isfinite(own)]
            cells[f"{name}: dropped"] = len(own) - len(known)
            if len(known):
                cells[f"{name}: median"] = round(float(np.median(known)))
                cells[f"{name}: max"] = round(float(known.max()))
    columns = [f"{name}: {what}" for name in names for what in ("median", "max", "dropped")]
    by_part = {part: [cells] for part, cells in parts.items()}
    return [
        table_of(COLUMNS, rows, "sequence"),
        table_of(columns, by_part, "part", "Delay over time"),
    ]


PAGE = Page("pace", "Real time", DESCRIPTION, ROWS, measure, tables)

if __name__ == "__main__":
    PAGE.main()
