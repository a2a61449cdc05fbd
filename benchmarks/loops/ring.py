"""A long sequence through a ring of rooms, with and without what corrects its drift.

    python -m benchmarks.loops.ring [--seeds 3]

Added drift moves each new submap by 0.13 m in a random direction and turns it by a quarter of a
radian per metre. Only loops can correct it, since submaps and the odometry edges between them are
displaced alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.shared.recordings import room
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import finished_slam
from benchmarks.shared.tables import Metrics, Rows, Target, table_of, targets_of
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import RunSettings
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.system import Slam

DRIFT_M = 0.13
RADIANS_PER_METRE = 0.25
_ATE, _LOOPS = "trajectory.ate_rmse_cm", "loops.verified.overlap"
COLUMNS = (
    *(_ATE, "images.mapped.psnr_db", "images.mapped.ssim", "semantics.mapped.miou_percent"),
    *("map.walls.thickness_cm", "map.walls.thickness_p95_cm"),
    *(f"{_LOOPS}.precision_percent", f"{_LOOPS}.recall_percent", "loops", "keyframes moved"),
    *("submaps", "map.gaussians", "frames.lost", "memory.peak_mb"),
    *("time.tracking_ms_per_frame", "time.mapping_ms_per_frame", "time.refinement_ms_per_frame"),
)
EVERYTHING = "loops and refinement"
DRIFTED = f"{EVERYTHING}, {DRIFT_M} m of drift per submap"
DESCRIPTION = """\
The synthetic ring (`semsplat make-room --layout ring --frames 900 --sensor-noise --seed SEED`):
four rooms, 26 m of path, the last quarter revisits the first room. With several seeds, each has a
ring of its own, and a row is the median over them."""
_ODOMETRY = {"loops": {"use": False}, "mapping": {"final_iterations": 0}}
# Settings that differ from the defaults, and the displacement of each new submap.
ROWS: dict[str, dict[str, Any]] = {
    "no loops, no refinement": {"settings": _ODOMETRY, "drift_m": 0.0},
    EVERYTHING: {"settings": {}, "drift_m": 0.0},
    DRIFTED: {"settings": {}, "drift_m": DRIFT_M},
}


def targets(rows: Rows) -> list[Target]:
    """What loops and refinement should reach."""
    return targets_of(
        rows,
        at_most=(
            ("ATE in cm", EVERYTHING, _ATE, 0.5),
            ("ATE with added drift in cm", DRIFTED, _ATE, 1.5),
        ),
        at_least=(
            ("precision of loops in %", EVERYTHING, f"{_LOOPS}.precision_percent", 100.0),
            ("recall of loops in %", EVERYTHING, f"{_LOOPS}.recall_percent", 85.0),
        ),
    )


def measure(job: dict[str, Any], seed: int) -> Metrics:
    """Run one variant; metrics.json and what its loops did."""
    place = room("ring", seed)
    source = {"dataset": {"kind": "synthetic", "path": str(place)}, "seed": seed}
    settings = validated(RunSettings, job["settings"] | source)

    def prepare(slam: Slam) -> None:
        if job["drift_m"]:
            add_drift(slam.atlas, job["drift_m"], seed)

    with finished_slam(settings, open_dataset("synthetic", place), prepare) as run:
        between = [r for r in run.records if r["kind"] == "correction between"]
        within = [r for r in run.records if r["kind"] == "correction within" and r["applied"]]
        return run.metrics | {
            "submaps": len(run.result.submaps),
            "loops": between[-1]["loops"] if between else 0,
            "keyframes moved": len(within),
        }


def add_drift(atlas: Atlas, metres: float, seed: int) -> None:
    """Displace each new submap from where the camera is."""
    start, generator = atlas.start, np.random.default_rng(seed)

    def start_displaced(submap: Submap) -> None:
        directions = generator.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        error = se3.exp(metres * np.concatenate([directions[0], RADIANS_PER_METRE * directions[1]]))
        submap.T_world_submap = submap.T_world_submap @ error
        start(submap)

    atlas.start = start_displaced  # type: ignore[method-assign]


PAGE = Page(
    "ring-summary",
    "Ring of rooms: summary",
    DESCRIPTION,
    ROWS,
    measure,
    lambda rows: [table_of(COLUMNS, rows)],
    targets,
)

if __name__ == "__main__":
    PAGE.main()
