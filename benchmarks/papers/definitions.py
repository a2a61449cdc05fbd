"""Which rows correspond to the tables of the papers, and what the papers report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from benchmarks.papers.plans import LONG, REAL_FRAMES
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
    "SSIM": "images.mapped.ssim",
    "MS-SSIM": "images.mapped.ms_ssim",
    "depth L1 cm": "depth.mapped.l1_cm",
    "mIoU %": "semantics.mapped.miou_percent",
    "groups, mIoU %": "semantics.mapped.level_1.miou_percent",
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


@dataclass(frozen=True)
class RunRow:
    """Runs that one row is the mean of.

    Attributes:
        group, settings: of the plan.
        sequence: sequences whose name begins so; all of the group if None.
        paper: the published values, as text.
    """

    group: str
    settings: str
    sequence: str | None = None
    paper: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table of runs.

    Attributes:
        title: with the numbers of the papers' tables.
        columns: keys of `paper_columns.COLUMNS`.
        rows: by title.
        note: below the table.
    """

    title: str
    columns: tuple[str, ...]
    rows: Mapping[str, RunRow]
    note: str = ""


def _rows(group: str, *rows: tuple[str, ...]) -> dict[str, RunRow]:
    """Rows of a group of runs: title, settings, and the published values if there are any."""
    return {title: RunRow(group, name, None, *paper) for title, name, *paper in rows}


def _with_network(group: str, *settings: str) -> dict[str, RunRow]:
    """Rows of a group with true labels, and with the network instead."""
    sequence = {"classes": "room", "classes-loops": "rings"}[group]
    return {
        f"{sequence}, {name}, {source}": RunRow(group, name + suffix)
        for name in settings
        for source, suffix in (("labels", ""), ("network", "-network"))
    }


_QUALITY = ("ATE cm", "PSNR dB", "SSIM", "depth L1 cm", "mIoU %", "lost", "ms per frame")
_H_REPLICA = "ATE {}, PSNR {}, MS-SSIM {}, depth L1 {}, mIoU {} (Replica, 8 scenes)"
_SYSTEMS = {
    "hier-slam (one-hot)": RunRow(
        "hier-synthetic", "hier-slam", None, _H_REPLICA.format(0.31, 35.61, 0.980, 0.48, 89.41)
    ),
    "hier-slam (binary)": RunRow(
        "hier-synthetic",
        "hier-slam-binary",
        None,
        _H_REPLICA.format(0.31, 35.68, 0.981, 0.49, 81.27),
    ),
    "gausem": RunRow(
        "gausem-synthetic",
        "gausem",
        None,
        "ATE 0.24, PSNR 39.94, SSIM 0.970, mIoU 95.81 (Replica, 8 scenes)",
    ),
    "default": RunRow("ours-synthetic", "default"),
    "best": RunRow("ours-synthetic", "best"),
}


def _systems(sequence: str) -> dict[str, RunRow]:
    return {
        f"{sequence}, {title}": RunRow(row.group, row.settings, sequence, row.paper)
        for title, row in _SYSTEMS.items()
    }


def _real(sequence: str, paper: Mapping[str, str]) -> dict[str, RunRow]:
    groups = {"hier-slam": "papers-real", "gausem": "papers-real"}
    return {
        f"{sequence}, {name}": RunRow(
            groups.get(name, "ours-real"), name, sequence, paper.get(name, "")
        )
        for name in ("hier-slam", "gausem", "default", "best")
    }


_TUM = {
    "hier-slam": "ATE 5.62 (TUM, 5 sequences)",
    "gausem": "ATE 2.83, PSNR 27.48, SSIM 0.861 (TUM, 5 sequences)",
}
TABLES: tuple[PaperTable, ...] = (
    PaperTable(
        "H-I, H-IV, H-V, G-I: tracking and mapping, synthetic",
        _QUALITY,
        _systems("office0") | _systems("room"),
        "20 views of office0 at given poses, and 30 frames of the room.",
    ),
    PaperTable(
        "H-V: MS-SSIM",
        ("PSNR dB", "SSIM", "MS-SSIM"),
        _rows(
            "ms-ssim",
            ("hier-slam", "hier-slam", "PSNR 35.61, MS-SSIM 0.980"),
            ("gausem", "gausem", "PSNR 39.94, SSIM 0.970"),
            *(("default", "default"), ("best", "best")),
        ),
        "The first 8 frames of the room at 240x180, which MS-SSIM needs. H prints MS-SSIM as SSIM; "
        "G does not say which it is.",
    ),
    PaperTable(
        "H-III, G-II to G-V: tracking and mapping, real sensors",
        ("ATE cm", "PSNR dB", "SSIM", "depth L1 cm", "lost", "ms per frame"),
        _real("redkitchen", {}) | _real("fr1_rpy", _TUM) | _real("hololens", {}),
        f"The first {REAL_FRAMES} frames. Published: other sequences of TUM.",
    ),
    PaperTable(
        "H-VI: time per iteration and frame of Hier-SLAM++, by code",
        (
            *("tracking ms per iteration", "mapping ms per iteration", "tracking ms per frame"),
            *("mapping ms per frame", "map MB"),
        ),
        _rows(
            "cost",
            ("without semantics", "none", "18.7, 22.9, 750, 1380 (RTX 4090, Replica room0)"),
            ("flat", "flat", "168.9, 204.3, 6750, 12260 (L40S)"),
            ("one-hot", "one-hot", "37.6, 194.8, 1500, 11690 (4090); 62.2, 212.6 (L40S)"),
            ("binary", "binary", "31.2, 92.6, 1250, 5560 (4090); 58.9, 210.7 (L40S)"),
        ),
        "The first six frames of the room at 160x120; 40 iterations of tracking, 60 of mapping per "
        "frame.",
    ),
    PaperTable(
        "G-VII: the system with and without landmarks",
        (
            *("search precision %", "search recall %", "search F1 %", "verified precision %"),
            *("verified recall %", "PSNR dB", "ATE cm"),
        ),
        _rows(
            "loops",
            ("descriptor alone, untested", "descriptor", "ATE 5.25-9.81, PSNR 22.4-27.7 (ScanNet)"),
            ("landmarks, untested", "landmarks"),
            (
                "landmarks as printed, untested",
                "landmarks-printed",
                "ATE 4.41-7.79, PSNR 28.5-30.4 (ScanNet)",
            ),
            ("default: by rank, tested", "default"),
        ),
        "Rings of rooms, without the final refinement; truth as G defines it. Untested: "
        "`--loops.no-verify`, candidates below the encoder's distance; every candidate is a loop.",
    ),
    PaperTable(
        "G-VIII: ablation of the default system",
        ("ATE cm", "PSNR dB", "SSIM", "mIoU %", "walls cm", "lost"),
        _rows(
            "ablation",
            ("default", "default"),
            (
                "allocation by motion instead of overlap and classes",
                "allocation-motion",
                "-1.68 dB, -2.65 %, +0.24 cm",
            ),
            (
                "with semantic seeding",
                "seeding-semantic",
                "+0.63 dB, +0.68 %, -0.04 cm (w/o to with)",
            ),
            ("no loops", "no-loops", "-2.07 dB, -4.60 %, +1.35 cm"),
            ("no refinement", "no-refinement", "-1.77 dB, -3.44 %, +0.56 cm"),
        ),
        "Five rings of rooms. Published differences to the whole system: six scenes of ScanNet.",
    ),
    PaperTable(
        "G-VIII: ablation of GauSem-SLAM as printed",
        ("ATE cm", "PSNR dB", "SSIM", "mIoU %", "walls cm", "lost"),
        _rows(
            "gausem-ablation",
            ("gausem", "gausem", "29.58 dB, 0.873, 86.65 %, 6.86 cm (ScanNet)"),
            ("w/o semantic allocation", "motion", "27.90, 0.860, 84.00, 7.10"),
            ("w/o semantic initialisation", "cells", "28.95, 0.870, 85.97, 6.90"),
            ("w/o loop closure", "no-loops", "27.51, 0.850, 82.05, 8.21"),
            ("w/o global refinement", "no-refinement", "27.81, 0.852, 83.21, 7.42"),
            ("with tests of loops", "tested"),
            ("default", "default"),
        ),
        "One ring of rooms at 120x90, 1.5 cm and up to 2 degrees per frame.",
    ),
    PaperTable(
        "G-VIII: ablation of mapping as printed, at given poses",
        ("ATE cm", "PSNR dB", "SSIM", "mIoU %", "walls cm"),
        _rows(
            "gausem-given",
            ("gausem", "gausem"),
            ("w/o semantic allocation", "motion"),
            ("w/o semantic initialisation", "cells"),
            ("w/o global refinement", "no-refinement"),
        ),
        "The ring of the default's ablation at 120x90, with 6 cm and up to 8 degrees per frame, "
        "which neither 40 steps of Adam nor a map of every fifth frame can follow. The refinement "
        "moves keyframes and anchors, and there are no loops.",
    ),
    PaperTable(
        "Systems with classes from depth alone instead of labels",
        ("ATE cm", "PSNR dB", "SSIM", "mIoU %", "groups, mIoU %", "lost"),
        _with_network("classes", "hier-slam", "gausem", "default")
        | _with_network("classes-loops", "default"),
        "The room and three rings of rooms; true labels renamed to the 22 classes that the network "
        "knows.",
    ),
    PaperTable(
        "Loops with classes from depth alone instead of labels",
        (
            *("search precision %", "search recall %", "search F1 %", "verified precision %"),
            *("verified recall %", "PSNR dB", "ATE cm"),
        ),
        _with_network("classes-loops", "landmarks", "default"),
        "Three rings of rooms; landmarks: untested, without the final refinement.",
    ),
    PaperTable(
        "GauSem-SLAM as a system, long runs",
        ("ATE cm", "PSNR dB", "SSIM", "mIoU %", "lost", "ms per frame", "peak MB"),
        {
            "ring-slow, gausem": RunRow("gausem-ablation", "gausem"),
            "ring-slow, default": RunRow("gausem-ablation", "default"),
            "ring-0, gausem": RunRow("long-gausem", "gausem", "ring-0"),
            "ring-0, default": RunRow("ablation", "default", "ring-0"),
        }
        | {
            f"{sequence}, {settings}": RunRow(group, settings, sequence)
            for sequence in LONG
            for group, settings in (("long-gausem", "gausem"), ("long", "default"))
        },
        "The whole rings, the slow one and gausem at 120x90; 120 frames of the others. Labels of "
        "real sequences are those of planes.",
    ),
)
