"""Columns of the papers' tables: metrics of runs."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.shared.tables import Metrics


def _per_iteration(stage: str, iterations: int) -> Callable[[Metrics], float | None]:
    """Milliseconds per iteration, from those per frame."""

    def value(run: Metrics) -> float | None:
        found = run.get(f"time.{stage}_ms_per_frame")
        return None if found is None else found / iterations

    return value


# Metrics by the title of their column.
COLUMNS: dict[str, str | Callable[[Metrics], float | None]] = {
    "ATE cm": "trajectory.ate_rmse_cm",
    "PSNR dB": "images.mapped.psnr_db",
    "unseen PSNR dB": "images.unseen.psnr_db",
    "SSIM": "images.mapped.ssim",
    "MS-SSIM": "images.mapped.ms_ssim",
    "depth L1 cm": "depth.mapped.l1_cm",
    "mIoU %": "semantics.mapped.miou_percent",
    "unseen mIoU %": "semantics.unseen.miou_percent",
    "subset mIoU %": "semantics.mapped.miou_subset_percent",
    "map MB": "memory.map_mb",
    "peak MB": "memory.peak_mb",
    "lost": "frames.lost",
    "ms per frame": "time.total_ms_per_frame",
    "tracking ms per frame": "time.tracking_ms_per_frame",
    "mapping ms per frame": "time.mapping_ms_per_frame",
    "tracking ms per iteration": _per_iteration("tracking", 40),
    "mapping ms per iteration": _per_iteration("mapping", 60),
    "search precision %": "loops.suspected.intervals.precision_percent",
    "search recall %": "loops.suspected.intervals.recall_percent",
    "search F1 %": "loops.suspected.intervals.f1_percent",
    "verified precision %": "loops.verified.intervals.precision_percent",
    "verified recall %": "loops.verified.intervals.recall_percent",
    "walls cm": "map.walls.thickness_cm",
}
