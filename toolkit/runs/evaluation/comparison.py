"""Compare runs on one self-contained HTML page: settings that differ, metrics, paths and views."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.charts import Axes, Series, line_chart
from toolkit.runs.evaluation.metrics import MetricValue

_MAX_IMAGE_WIDTH = 480
_JPEG_QUALITY = 88
_MIN_SHARED_VIEWS = 2
_ABSENT = "n/a"
# Colours of lines are distinguishable for this many runs; they repeat afterwards.
_LINE_COLOURS = 6

# Whether small or large values of a metric are better, by patterns of its name; the first match
# counts. Metrics without a match, such as the number of frames, have no best value.
_BETTER = (
    (r"convention|views$|frames.total|keyframes|coverage|observed|ate_pairs", None),
    (r"ate_|rpe_|drift|error|lost|_late|dropped|lpips|l1_cm|thickness|floaters|ece_", "low"),
    (r"doubtful|other_parts", "low"),
    (r"accuracy_cm|completion_cm|_ms(_|$)|_s$|delay|memory|_mb$", "low"),
    (r"psnr|ssim|iou_|accuracy|f_score|ratio_percent|precision|recall|f1_|consistency", "high"),
)
_HIGHLIGHTS = (
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "images.unseen.psnr_db",
    "images.mapped.ssim",
    "depth.mapped.l1_cm",
    "semantics.mapped.miou_percent",
    "mesh.f_score_2cm_percent",
    "time.tracking_ms_per_frame",
    "time.mapping_ms_per_frame",
    "map.gaussians",
    "memory.peak_mb",
    "frames.lost",
    "frames.doubtful",
    "frames.in_other_parts",
)


@dataclass(frozen=True)
class ComparedRun:
    """One run of a comparison.

    Attributes:
        name: unique name.
        settings: settings by dotted key.
        metrics: content of metrics.json by dotted key.
        estimate: estimated poses in the frame of the map.
        views: rendered images [H, W, 3] uint8 RGB by file name.
        report: URL of the report relative to the page, or None.
    """

    name: str
    settings: Mapping[str, Any]
    metrics: Mapping[str, MetricValue]
    estimate: Trajectory
    views: Mapping[str, NDArray[np.uint8]]
    report: str | None = None


@dataclass(frozen=True)
class _Cell:
    """A value in a table and its highlight ("best", "worst" or "")."""

    text: str
    css_class: str = ""


def render_comparison(runs: Sequence[ComparedRun]) -> str:
    """Render the page as HTML.

    Args:
        runs: at least two.
    """
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = resources.files(__package__).joinpath("comparison_template.html").read_text("utf-8")
    metrics = metric_rows(runs)
    return environment.from_string(template).render(
        runs=runs,
        settings=setting_rows(runs),
        highlights=[row for key in _HIGHLIGHTS for row in metrics if row[0] == key],
        metrics=metrics,
        conventions=_convention_rows(runs),
        chart=_path_chart(runs),
        views=_view_rows(runs),
    )


def setting_rows(runs: Sequence[ComparedRun]) -> list[tuple[str, list[str]]]:
    """Return the settings that differ: key, and the value of each run."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    rows = [(key, [_setting(run.settings, key) for run in runs]) for key in keys]
    return [row for row in rows if len(set(row[1])) > 1]


def metric_rows(runs: Sequence[ComparedRun]) -> list[tuple[str, list[_Cell]]]:
    """Return the numerical metrics: key, and a cell for each run with its highlight."""
    keys = dict.fromkeys(key for run in runs for key in run.metrics)
    rows = []
    for key in keys:
        values = [run.metrics.get(key) for run in runs]
        if any(_is_number(value) for value in values):
            rows.append((key, _cells(key, values)))
    return rows


def _cells(key: str, values: Sequence[MetricValue]) -> list[_Cell]:
    texts = [_text(value) for value in values]
    numbers = [float(v) for v in values if isinstance(v, (int, float))]
    better = direction(key)
    if len(set(texts)) == 1 or better is None or len(numbers) < 2:
        return [_Cell(text, "differs" if len(set(texts)) > 1 else "") for text in texts]
    best, worst = min(numbers), max(numbers)
    if better == "high":
        best, worst = worst, best
    classes = {_text(worst): "worst", _text(best): "best"}
    return [_Cell(text, classes.get(text, "")) for text in texts]


def direction(key: str) -> str | None:
    """Return whether "low" or "high" values of a metric are better, None if neither is."""
    return next((better for pattern, better in _BETTER if re.search(pattern, key)), None)


def _convention_rows(runs: Sequence[ComparedRun]) -> list[tuple[str, list[str]]]:
    """Return texts of the metrics that differ: such metrics are not comparable."""
    keys = dict.fromkeys(key for run in runs for key in run.metrics)
    rows = []
    for key in keys:
        texts = [run.metrics.get(key) for run in runs]
        distinct = {text for text in texts if isinstance(text, str)}
        if len(distinct) > 1:
            rows.append((key, [_text(text) for text in texts]))
    return rows


def _path_chart(runs: Sequence[ComparedRun]) -> Markup:
    """Draw the paths from above, each in the axes of the first camera of its run."""
    series = [
        Series(run.estimate.positions_m[:, [0, 2]], run.name, f"run{number % _LINE_COLOURS}")
        for number, run in enumerate(runs)
        if len(run.estimate)
    ]
    axes = Axes("right of the first camera, m", "in front of the first camera, m", equal=True)
    return line_chart(series, axes)


def _view_rows(runs: Sequence[ComparedRun]) -> list[list[tuple[str, str | None]]]:
    """Return rows of views: for each run, the name of a view and its image as a data URL, or None.

    A row shows the same frame of all runs. Runs of different length have few frames in common;
    the views of a row are then those at the same place in each run.
    """
    names = sorted({name for run in runs for name in run.views})
    rows = [[name] * len(runs) for name in names if sum(name in r.views for r in runs) > 1]
    if len(rows) < _MIN_SHARED_VIEWS:
        places = range(max((len(run.views) for run in runs), default=0))
        rows = [[_at(sorted(run.views), place) for run in runs] for place in places]
    return [
        [
            (name.partition(".")[0], _image(run.views.get(name)))
            for run, name in zip(runs, row, strict=True)
        ]
        for row in rows
    ]


def _at(names: Sequence[str], place: int) -> str:
    return names[place] if place < len(names) else ""


def _image(rgb: NDArray[np.uint8] | None) -> str | None:
    if rgb is None:
        return None
    height, width = rgb.shape[:2]
    if width > _MAX_IMAGE_WIDTH:
        size = (_MAX_IMAGE_WIDTH, round(height * _MAX_IMAGE_WIDTH / width))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), options)
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()


def _setting(settings: Mapping[str, Any], key: str) -> str:
    return str(settings[key]) if key in settings else _ABSENT


def _is_number(value: MetricValue) -> bool:
    return isinstance(value, (int, float))


def _text(value: MetricValue) -> str:
    if value is None:
        return _ABSENT
    return f"{value:.5g}" if isinstance(value, float) else str(value)
