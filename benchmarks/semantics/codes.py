"""What semantics cost and how accurate labels are, code by code.

    SEMSPLAT_DATA=DATA python -m benchmarks.semantics.codes quality [--seeds 3]
    python -m benchmarks.semantics.codes room

Each run is a process of its own with default settings except for what its row names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro

from benchmarks.accuracy.sequences import measure
from benchmarks.shared.runner import Options, Page
from benchmarks.shared.tables import Rows, Target, median_of, table_of, targets_of

PageName = Literal["quality", "room"]
CODES = ("none", "flat", "one-hot", "binary")
MAPPED, UNSEEN = "semantics.mapped.miou_percent", "semantics.unseen.miou_percent"
COARSEST = "semantics.mapped.level_0.miou_percent"
_PSNR = "images.mapped.psnr_db"
_GEOMETRY = (_PSNR, "images.unseen.psnr_db", "images.mapped.ssim", "depth.mapped.l1_cm")
_LABELS = (MAPPED, UNSEEN, COARSEST, "semantics.mapped.ece_percent")
_END = (
    *("time.mapping_ms_per_frame", "time.refinement_ms_per_frame"),
    *("memory.map_mb", "memory.peak_mb"),
)
COLUMNS: dict[PageName, tuple[str, ...]] = {
    "quality": (
        *(*_GEOMETRY, *_LABELS, "semantics.unseen.level_0.miou_percent"),
        *("semantics.mapped.miou_visible_percent", "semantics.mapped.miou_subset_percent"),
        *("semantics.unseen.miou_subset_percent", *_END),
    ),
    "room": (
        *("trajectory.ate_rmse_cm", *_GEOMETRY, *_LABELS),
        *("semantics.unseen_refined.miou_percent", "semantics.mapped.classes"),
        *("time.tracking_ms_per_frame", "time.labelling_ms_per_frame", *_END),
    ),
}
_GIVEN = ("--poses", "given", "--hold-out", "5", "--evaluation.subset")
ROWS: dict[PageName, dict[str, list[str]]] = {
    "quality": {
        kind: ["office0", *_GIVEN, "--semantics.code.kind", kind] for kind in (*CODES, "colour")
    },
    "room": {kind: ["room", "--semantics.code.kind", kind] for kind in CODES},
}


def _below(rows: Rows, row: str, other: str, column: str = MAPPED) -> float | None:
    median = median_of(rows)
    a, b = median(other, column), median(row, column)
    return None if a is None or b is None else a - b


def quality_targets(rows: Rows) -> list[Target]:
    """Accuracy of labels with given poses; codes beside each other."""
    one_hot, binary = "one-hot", "binary"
    found = targets_of(
        rows,
        at_least=(
            ("one-hot, mIoU of mapped views in %", one_hot, MAPPED, 97),
            ("one-hot, mIoU of unseen views in %", one_hot, UNSEEN, 94.5),
            ("one-hot, coarsest level in %", one_hot, COARSEST, 99),
        ),
    )
    for row, other, views, column, bound in (
        (one_hot, "flat", "mapped, points", MAPPED, 1),
        (binary, "flat", "mapped, points", MAPPED, 2),
        (binary, one_hot, "mapped, points", MAPPED, 1),
        (binary, one_hot, "unseen, points", UNSEEN, 1),
        (one_hot, "none", "PSNR in dB", _PSNR, 0.1),
    ):
        below = _below(rows, row, other, column)
        found.append(Target(f"{row} below {other}, {views}", below, at_most=bound))
    return found


def room_targets(rows: Rows) -> list[Target]:
    """Accuracy of labels on a tracked room."""
    median, found = median_of(rows), []
    for row, bound in (("one-hot", 95), ("binary", 93)):
        mapped = median(row, MAPPED)
        found.append(Target(f"{row}, mIoU of mapped views in %", mapped, at_least=bound))
        for views, what in (("unseen_refined", "poses refined"), ("unseen", "true poses")):
            unseen = median(row, f"semantics.{views}.miou_percent")
            less = None if mapped is None or unseen is None else mapped - unseen
            found.append(Target(f"{row}, less on unseen views, {what}, points", less, at_most=3))
    return found


PAGES: dict[PageName, Page] = {
    "quality": Page(
        "semantics-quality",
        "Semantic codes, poses given",
        "`semsplat run` on Replica office0 (600x340) with `--poses given --hold-out 5`: every "
        "fifth view is kept out of the map and is an unseen view. The tree is the shipped one of "
        "Replica's 101 classes (5 levels). Subset mIoU decodes each view among the classes of its "
        "own ground truth (`--evaluation.subset`).",
        ROWS["quality"],
        measure,
        lambda rows: [table_of(COLUMNS["quality"], rows)],
        quality_targets,
    ),
    "room": Page(
        "semantics-room",
        "Semantic codes, tracked",
        "`semsplat run` on the synthetic room (`semsplat make-room`, 300 frames of 320x240), "
        "tracked and mapped. Unseen views lie off the path; refined ones have their poses refined "
        "on the map.",
        ROWS["room"],
        measure,
        lambda rows: [table_of(COLUMNS["room"], rows)],
        room_targets,
    ),
}


@dataclass(frozen=True, kw_only=True)
class CodeOptions(Options):
    """Measure semantic codes."""

    page: tyro.conf.Positional[PageName] = "quality"
    """Which page."""


def main() -> None:
    """Measure one page."""
    options = tyro.cli(CodeOptions)
    PAGES[options.page].write(options)


if __name__ == "__main__":
    main()
