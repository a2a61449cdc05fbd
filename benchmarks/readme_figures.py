"""Fills README's figures from the files of results.

    python -m benchmarks.readme_figures            replace what lies between the markers
    python -m benchmarks.readme_figures --check    exit with 1 if README differs from the results

The markers are `<!-- figures -->` and `<!-- /figures -->`.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import tyro

from benchmarks.accuracy import sequences
from benchmarks.accuracy.compare_open3d import TITLES
from benchmarks.papers.plans import REAL_FRAMES
from benchmarks.semantics.indoor import HEAD_TITLE, POINTS_TITLE
from benchmarks.shared.repository import ROOT
from benchmarks.shared.results_file import RESULTS, Results, read_results
from benchmarks.shared.tables import MISSING, Table

README = ROOT / "README.md"
BEGIN, END = "<!-- figures -->", "<!-- /figures -->"

# Settings of Open3D, as README calls them.
_OPEN3D = {
    "dense-slam": "dense SLAM",
    "dense-slam-tuned": "dense SLAM, 30/20/10 iterations",
    "odometry": "hybrid odometry",
    "odometry-planes": "point-to-plane odometry",
}
_PAPERS, _REAL = "tables", "H-III, G-II to G-V: tracking and mapping, real sensors"
# Table of the file and sequence of each row.
_PLACES = {
    f"RedKitchen, {REAL_FRAMES} frames": (_REAL, "redkitchen"),
    f"fr1/rpy, {REAL_FRAMES} frames": (_REAL, "fr1_rpy"),
    "ring of rooms, 1800 frames": ("GauSem-SLAM as a system, long runs", "ring-slow"),
}
_ATE = "ATE RMSE cm (SE(3))"
_MISSED = "**missed**"
_INDOOR = "indoor"
_BY_HAND = {
    "redkitchen-native": "RedKitchen",
    "fr1_rpy": "fr1/rpy",
    "hololens": "HoloLens walk",
}
_WITH_TARGETS = (
    *("sequences", "open3d-redkitchen", "open3d-fr1_rpy", "open3d-office0"),
    *("semantics-quality", "semantics-room", "ring-summary", "registration-redkitchen"),
)


class Figures:
    """Cells of the files of results.

    Args:
        folder: of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, Results] = {}

    def file(self, name: str) -> Results:
        """A file of results by its name."""
        if name not in self._files:
            self._files[name] = read_results(self._folder / f"{name}.md")
        return self._files[name]

    def cell(self, name: str, row: str, column: str, unit: str = "", digits: int = 2) -> str:
        """A number of the first table with its unit; n/a where there is none."""
        try:
            text = self.file(name).table().cell(row, column)
            return f"{float(text):.{digits}f}{unit}"
        except (KeyError, ValueError):
            return MISSING

    def mean(self, name: str, title: str, row: str, column: str, unit: str, digits: int) -> str:
        """The mean of a cell "mean ± deviation" of a table with a title; n/a if there is none."""
        try:
            text = self.file(name).table(title).cell(row, column)
            return f"{float(text.partition(' ')[0]):.{digits}f}{unit}"
        except (KeyError, ValueError):
            return MISSING

    def source(self, *names: str) -> str:
        """Where numbers come from: links to the files, with commits."""
        return ", ".join(
            f"[{name}](benchmarks/{RESULTS.name}/{name}.md) at {self.file(name).header.code.commit}"
            for name in names
        )


def readme_figures(folder: Path = RESULTS) -> str:
    """The Markdown between the markers."""
    figures = Figures(folder)
    parts = (_sequences, _open3d, _papers, _labels, _missed)
    lines = "\n\n".join(part(figures) for part in parts).split("\n")
    return "\n".join(_wrapped(line) for line in lines)


def _wrapped(line: str) -> str:
    """A line of prose wrapped at 100 characters; tables stay as they are."""
    if line.startswith("|"):
        return line
    indent = "  " if line.startswith("- ") else ""
    return textwrap.fill(
        line, 100, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _sequences(figures: Figures) -> str:
    columns = (
        ("ATE RMSE", "trajectory.ate_rmse_cm", " cm", 2),
        ("mapped views", "images.mapped.psnr_db", " dB", 1),
        ("unseen views", "images.unseen.psnr_db", " dB", 1),
        ("unseen, refined", "images.unseen_refined.psnr_db", " dB", 1),
        ("loop recall", "loops.verified.overlap.recall_percent", " %", 1),
        ("tracking", "time.tracking_ms_per_frame", " ms", 0),
        ("mapping", "time.mapping_ms_per_frame", " ms", 0),
        ("refinement", "time.refinement_ms_per_frame", " ms", 0),
    )
    rows = []
    for name in sequences.ROWS:
        cells = [figures.cell("sequences", name, key, unit, n) for _, key, unit, n in columns]
        if name == sequences.GIVEN:
            cells[0] = MISSING
        rows.append((name, *cells))
    table = Table(("sequence", *(title for title, *_ in columns)), tuple(rows))
    header = figures.file("sequences").header
    seeds = "seed 0" if header.seeds == (0,) else f"medians of {len(header.seeds)} seeds"
    return (
        f"Default settings, semantics on, {seeds}, {header.machine.split(';')[0]}, "
        f"{header.threads} threads; times per frame. {figures.source('sequences')}. All "
        "results: [benchmarks/RESULTS.md](benchmarks/RESULTS.md).\n\n" + table.markdown()
    )


def _open3d(figures: Figures) -> str:
    names = {
        "open3d-redkitchen": "RedKitchen",
        "open3d-fr1_rpy": "fr1/rpy",
        "open3d-office0": "office0",
    }
    parts = []
    for name, title in names.items():
        ours, avx2 = TITLES["semsplat"], TITLES["semsplat-avx2"]
        best = _best_of_open3d(figures, name)
        theirs, ate = (figures.cell(name, row, _ATE, " cm") for row in (TITLES[best], ours))
        time = figures.cell(name, TITLES[best], "whole frame ms", " ms", 0)
        online, whole = (
            [figures.cell(name, row, column, digits=0) for row in (ours, avx2)]
            for column in ("online ms", "whole frame ms")
        )
        parts.append(
            f"{title} {theirs}, {time} with {_OPEN3D[best]} (semsplat {ate}, "
            f"{online[0]} / {whole[0]} ms; AVX2 {online[1]} / {whole[1]} ms)"
        )
    return (
        "The most accurate of four settings of Open3D on the same machine, ATE and time per frame "
        "(Open3D's odometry builds no map; semsplat: without / with the refinement): "
        f"{'; '.join(parts)}. {figures.source(*names)}."
    )


def _best_of_open3d(figures: Figures, name: str) -> str:
    """The setting of Open3D with the lowest ATE in a file of results."""

    def error_cm(setting: str) -> float:
        text = figures.cell(name, TITLES[setting], _ATE)
        return float("inf") if text == MISSING else float(text)

    return min(_OPEN3D, key=error_cm)


def _papers(figures: Figures) -> str:
    """The papers' systems and the default settings on the sequences of `make tables`."""
    settings = {"hier-slam": "Hier-SLAM++", "gausem": "GauSem-SLAM", "default": "semsplat"}
    columns = (("ATE cm", " cm", 2), ("PSNR dB", " dB", 1), ("ms per frame", " ms", 0))
    rows = []
    for title, (of_table, place) in _PLACES.items():
        cells = [
            [figures.mean(_PAPERS, of_table, f"{place}, {name}", *column) for column in columns]
            for name in settings
        ]
        rows.append(
            (title, *(MISSING if MISSING in found else ", ".join(found) for found in cells))
        )
    table = Table(("", *settings.values()), tuple(rows))
    return (
        "The papers' systems as printed (`--preset hier-slam` and `gausem`) at 160x120 (ring: "
        "120x90): ATE, mapped views, time per frame with the refinement. "
        "Errors of GauSem-SLAM on the ring [differ between machines](docs/papers.md). "
        f"{figures.source(_PAPERS)}.\n\n{table.markdown()}"
    )


def _labels(figures: Figures) -> str:
    quality, room = "semantics-quality", "semantics-room"
    mapped, unseen = "semantics.mapped.miou_percent", "semantics.unseen.miou_percent"

    def cell(name: str, column: str) -> str:
        return figures.cell(name, "one-hot", column, " %", 1)

    def from_depth(title: str, row: str, column: str) -> str:
        return figures.mean(_INDOOR, title, row, column, " %", 0)

    by_hand = [
        f"{from_depth(POINTS_TITLE, f'{source}, all views', 'right_percent')} ({title})"
        for source, title in _BY_HAND.items()
    ]
    head = from_depth(HEAD_TITLE, "office0", "accuracy_percent")
    return (
        f"Labels, mIoU over classes: office0 with given poses {cell(quality, mapped)} on mapped "
        f"and {cell(quality, unseen)} on unseen views; synthetic room of 40 classes, tracked, "
        f"{cell(room, mapped)} and {cell(room, unseen)} "
        f"({cell(room, 'semantics.unseen_refined.miou_percent')} with refined poses). Without "
        f"labels, of points named by hand, the group is right at {', '.join(by_hand)}; with the "
        f"labels of ten frames, {head} of the pixels of the others. "
        f"{figures.source(quality, room, _INDOOR)}."
    )


def _missed(figures: Figures) -> str:
    """Targets that are missed."""
    lines = []
    for name in _WITH_TARGETS:
        missed = [row for row in _targets(figures.file(name)) if _MISSED in row[-1]]
        if missed:
            measured = "; ".join(f"{what}: {value}, {bar}" for what, bar, value, _ in missed)
            lines.append(f"- {name}: {measured}.")
    return "Missed targets:\n\n" + "\n".join(lines or ["- none"])


def _targets(results: Results) -> tuple[tuple[str, ...], ...]:
    try:
        return results.table("Targets").rows
    except KeyError:
        return ()


def filled(readme: str, figures: str) -> str:
    """The text of README with other figures between the markers.

    Raises:
        ValueError: a marker is missing.
    """
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md lacks {END if begin else BEGIN}")
    return f"{before}{BEGIN}\n{figures}\n{END}{after}"


def main(check: bool = False) -> int:
    """Fill README's figures.

    Args:
        check: change nothing; exit with 1 if README differs from the results.
    """
    before = README.read_text(encoding="utf-8")
    after = filled(before, readme_figures())
    if check:
        return int(after != before)
    README.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
