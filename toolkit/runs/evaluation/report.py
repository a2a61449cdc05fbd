"""Report of a run as a single self-contained HTML file."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import atomic
from toolkit.io.length_names import METRES, LengthNames
from toolkit.io.visualisation import DepthSpan, LegendEntry, colour_image, depth_image
from toolkit.runs.evaluation.charts import Axes, Series, line_chart
from toolkit.runs.evaluation.frame_costs import FrameCosts, memory_chart, time_chart
from toolkit.runs.evaluation.frame_states import FrameState, ranges
from toolkit.runs.evaluation.loop_gallery import LoopPicture
from toolkit.runs.evaluation.metrics import Metrics, MetricValue, ate_frames, flattened
from toolkit.runs.evaluation.submap_graph import SubmapGraph, submap_graph_chart
from toolkit.runs.evaluation.timing import StageTime
from toolkit.runs.evaluation.trajectory import (
    AbsoluteTrajectoryError,
    AlignmentKind,
    absolute_trajectory_error,
)
from toolkit.scene.graph.floor_plan import ClassArea

# Limit the size of a report with six views to a few MB.
_MAX_IMAGE_WIDTH = 640
_JPEG_QUALITY = 88
# Entries of the legend below the classes of a view.
_LEGEND_ENTRIES = 5

# Title, dotted key, decimals and unit of the metrics at the top of the page.
_HEADLINES = (
    ("ATE RMSE", "trajectory.ate_rmse_cm", 2, "cm"),
    ("rotation drift", "trajectory.rpe_rotation_deg", 3, "deg a frame"),
    ("loop edges right", "loops.edges.right_percent", 1, "%"),
    ("PSNR, mapped views", "images.mapped.psnr_db", 2, "dB"),
    ("PSNR, unseen views", "images.unseen.psnr_db", 2, "dB"),
    ("depth L1", "depth.mapped.l1_cm", 2, "cm"),
    ("tracking", "time.tracking_ms_per_frame", 0, "ms a frame"),
    ("mapping", "time.mapping_ms_per_frame", 0, "ms a frame"),
    ("Gaussians", "map.gaussians", 0, ""),
    ("peak memory", "memory.peak_mb", 0, "MB"),
    ("frames lost", "frames.lost", 0, ""),
)


@dataclass(frozen=True)
class LevelImage:
    """The classes of a view at one level of the tree.

    Attributes:
        name: of the level.
        image: [H, W, 3] uint8 colours of the classes.
        legend: classes in the image, largest first.
    """

    name: str
    image: NDArray[np.uint8]
    legend: Sequence[LegendEntry]


@dataclass(frozen=True)
class ReportView:
    """Observed and rendered images of one view.

    Attributes:
        title: for instance "frame 40, unseen".
        observed_rgb, rendered_rgb: [H, W, 3] float in [0, 1].
        observed_depth_m, rendered_depth_m: [H, W] in metres, 0 where missing.
        psnr_db: PSNR of this view, or None.
        levels: rendered classes, coarsest level first; empty without semantics.
    """

    title: str
    observed_rgb: NDArray[np.floating]
    rendered_rgb: NDArray[np.floating]
    observed_depth_m: NDArray[np.floating]
    rendered_depth_m: NDArray[np.floating]
    psnr_db: float | None = None
    levels: Sequence[LevelImage] = ()


@dataclass(frozen=True)
class DelaySeries:
    """Delays of a run in real time.

    Attributes:
        arrival_s: time of arrival of each frame.
        delay_s: time from the arrival to the pose; nan for dropped frames.
        max_delay_s: the bound of the delay; None without one.
    """

    arrival_s: Sequence[float]
    delay_s: Sequence[float]
    max_delay_s: float | None


@dataclass(frozen=True)
class ReportFloorPlan:
    """The map seen from above.

    Attributes:
        image: [H, W, 3] uint8, classes, camera path and scale.
        areas: classes with their areas, largest first.
        objects: number in the image, name and relations of each object of a scene graph.
    """

    image: NDArray[np.uint8]
    areas: Sequence[ClassArea]
    objects: Sequence[tuple[str, str, str]] = ()


@dataclass(frozen=True)
class ReportContent:
    """Content of the report.

    Attributes:
        title: name of the run.
        subtitle: summary such as number of frames and image size.
        metrics: metrics of the run; missing ones are displayed as n/a.
        estimate: estimated poses in the map's frame, that of the first camera.
        truth: ground-truth poses in any frame, or None.
        alignment: kind of the alignment of estimate and ground truth.
        lost_at_s: timestamps of frames without a pose.
        views: observed and rendered images.
        stage_times: times by stage, sorted by decreasing total time.
        settings: the settings as YAML.
        warnings: warnings of one line each.
        names: of lengths.
        machine: description of the software and machine.
        delays: delays of a run in real time; None for other runs.
        floor_plan: the map from above; None without labels or without a floor.
        loops: pairs of images of the loop gallery.
        submaps: overlaps and loops of the submaps; None if there is only one.
        costs: time and memory by frame, or None.
        states: states of all frames, in order.
    """

    title: str
    subtitle: str
    metrics: Metrics
    estimate: Trajectory
    truth: Trajectory | None = None
    alignment: AlignmentKind = "se3"
    lost_at_s: Sequence[float] = ()
    views: Sequence[ReportView] = ()
    stage_times: Sequence[StageTime] = ()
    settings: str = ""
    warnings: Sequence[str] = field(default_factory=tuple)
    names: LengthNames = METRES
    machine: str = ""
    delays: DelaySeries | None = None
    floor_plan: ReportFloorPlan | None = None
    loops: Sequence[LoopPicture] = ()
    submaps: SubmapGraph | None = None
    costs: FrameCosts | None = None
    states: Sequence[FrameState] = ()


def write_report(path: str | os.PathLike[str], content: ReportContent) -> None:
    """Write report.html atomically.

    Raises:
        DatasetError: there is ground truth, but no poses can be associated in time.
        RunFolderError: the file cannot be written.
    """
    atomic.write_text(path, render_report(content))


def render_report(content: ReportContent) -> str:
    """Render the report as HTML.

    Raises:
        DatasetError: there is ground truth, but no poses can be associated in time.
    """
    has_truth = content.truth is not None and len(content.truth) > 0 and len(content.estimate) > 0
    error = None
    if has_truth and content.truth is not None:
        error = absolute_trajectory_error(content.estimate, content.truth, content.alignment)
    metrics = flattened(content.metrics)
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = resources.files(__package__).joinpath("report_template.html").read_text("utf-8")
    return environment.from_string(template).render(
        content=content,
        headlines=_headlines(metrics),
        path_chart=_trajectory_chart(content, error),
        error_chart=_error_chart(content, error),
        delay_chart=content.delays and _delay_chart(content.delays),
        stages=_stages(content.stage_times),
        views=[_embedded(view) for view in content.views],
        memory=_memory(metrics),
        states=ranges(content.states),
        loops=[_loop(picture) for picture in content.loops],
        submap_graph=content.submaps and submap_graph_chart(content.submaps),
        time_chart=content.costs and time_chart(content.costs),
        memory_chart=content.costs and memory_chart(content.costs),
        plan=None if content.floor_plan is None else _data_url(content.floor_plan.image),
        all_metrics=[(key, _text(value)) for key, value in sorted(metrics.items())],
    )


def _headlines(metrics: Mapping[str, MetricValue]) -> list[dict[str, str]]:
    headlines = []
    for title, key, digits, unit in _HEADLINES:
        value = metrics.get(key)
        if isinstance(value, (int, float)):
            headlines.append({"title": title, "value": f"{value:,.{digits}f}", "unit": unit})
        else:
            headlines.append({"title": title, "value": "n/a", "unit": ""})
    headlines[0]["unit"] = f"{headlines[0]['unit']} {ate_frames(metrics)}".strip()
    doubtful = metrics.get("frames.doubtful")
    if isinstance(doubtful, int) and doubtful > 0:
        headlines[-1]["unit"] = f"and {doubtful:,} doubtful"
    return headlines


def _trajectory_chart(content: ReportContent, error: AbsoluteTrajectoryError | None) -> Markup:
    """Draw both trajectories from above, in the axes of the first camera (x right, z forward)."""
    top = [0, 2]
    series = []
    if error is not None and content.truth is not None:
        T_map_world = se3.inverse(error.alignment.T_world_map)
        truth_m = se3.transform_points(T_map_world, content.truth.positions_m)
        series.append(Series(truth_m[:, top] / error.alignment.scale, "truth", "truth"))
    estimate_m = content.estimate.positions_m[:, top]
    series.append(Series(estimate_m, "estimate", "estimate"))
    series.append(Series(estimate_m[:1], "start", "estimate"))
    return line_chart(
        series,
        Axes(
            f"right of the first camera, {content.names.length}",
            f"in front of the first camera, {content.names.length}",
            equal=True,
        ),
    )


def _error_chart(content: ReportContent, error: AbsoluteTrajectoryError | None) -> Markup:
    """Draw the error over time and mark lost frames."""
    if error is None:
        return Markup()
    start_s = float(content.estimate.timestamps_s[0])
    lost_s = np.asarray(content.lost_at_s, dtype=np.float64)
    times_s = np.concatenate([error.timestamps_s, lost_s]) - start_s
    # Lost frames have no error; NaN interrupts the line.
    errors_cm = np.concatenate([100.0 * error.errors_m, np.full(len(lost_s), np.nan)])
    points = np.stack([times_s, errors_cm], axis=1)[np.argsort(times_s, kind="stable")]
    rmse_cm = 100.0 * error.rmse_m
    axes = Axes(
        "time, s",
        "distance to the truth, cm",
        level=(rmse_cm, f"RMSE {rmse_cm:.2f} cm"),
        marks_x=[float(time_s) for time_s in lost_s - start_s],
        marks_name="frame lost",
    )
    return line_chart([Series(points, "", "estimate")], axes)


def _delay_chart(delays: DelaySeries) -> Markup:
    """Draw the delay over time and mark dropped frames."""
    points = np.stack([delays.arrival_s, delays.delay_s], axis=1)
    points[:, 1] *= 1e3
    bound_s = delays.max_delay_s
    axes = Axes(
        "time of arrival, s",
        "delay of the pose, ms",
        level=None if bound_s is None else (1e3 * bound_s, f"maximum {1e3 * bound_s:.0f} ms"),
        marks_x=[float(x) for x, y in points if np.isnan(y)],
        marks_name="frame dropped",
    )
    return line_chart([Series(points, "", "estimate")], axes)


def _stages(stage_times: Sequence[StageTime]) -> list[dict[str, Any]]:
    longest_s = max((time.total_s for time in stage_times), default=0.0)
    return [
        {"time": time, "percent": 100.0 * time.total_s / longest_s if longest_s > 0 else 0.0}
        for time in stage_times
    ]


def _memory(metrics: Mapping[str, MetricValue]) -> list[tuple[str, str]]:
    """Return the rows of the memory table."""
    rows = [
        ("peak of the process", _megabytes(metrics.get("memory.peak_mb"))),
        ("parameters of the map", _megabytes(metrics.get("memory.map_mb"))),
    ]
    map_mb, gaussians = metrics.get("memory.map_mb"), metrics.get("map.gaussians")
    if isinstance(map_mb, (int, float)) and isinstance(gaussians, int) and gaussians > 0:
        rows.append(("a Gaussian", f"{1e6 * map_mb / gaussians:.0f} bytes"))
    return rows


def _megabytes(value: MetricValue) -> str:
    return f"{value:,.1f} MB" if isinstance(value, (int, float)) else "n/a"


def _text(value: Any) -> str:
    if value is None:
        return "n/a"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _embedded(view: ReportView) -> dict[str, Any]:
    """Return the title of a view and its images as data URLs, depths on one scale."""
    span = DepthSpan.of([view.observed_depth_m])
    score = "" if view.psnr_db is None else f"{view.psnr_db:.2f} dB"
    return {
        "title": view.title,
        "score": score,
        "near": f"{span.near_m:g}",
        "far": f"{span.far_m:g}",
        "observed": _photo_url(colour_image(view.observed_rgb)),
        "rendered": _photo_url(colour_image(view.rendered_rgb)),
        "observed_depth": _photo_url(depth_image(view.observed_depth_m, span)),
        "rendered_depth": _photo_url(depth_image(view.rendered_depth_m, span)),
        "levels": [
            {
                "name": level.name,
                "image": _data_url(level.image, cv2.INTER_NEAREST),
                "legend": level.legend[:_LEGEND_ENTRIES],
                "others": max(0, len(level.legend) - _LEGEND_ENTRIES),
            }
            for level in view.levels
        ],
    }


def _loop(picture: LoopPicture) -> dict[str, Any]:
    return {
        "pair": picture.pair,
        "query": _photo_url(colour_image(picture.query_rgb)),
        "match": _photo_url(colour_image(picture.match_rgb)),
    }


def _photo_url(rgb: NDArray[np.uint8]) -> str:
    """Return a photo or a colour-mapped image as JPEG, a third of the size of a PNG."""
    return _url("jpeg", _reduced(rgb, cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def _data_url(rgb: NDArray[np.uint8], interpolation: int = cv2.INTER_AREA) -> str:
    """Return a drawing or an image of classes as PNG, which keeps its colours."""
    return _url("png", _reduced(rgb, interpolation), [])


def _reduced(rgb: NDArray[np.uint8], interpolation: int) -> NDArray[np.uint8]:
    height, width = rgb.shape[:2]
    if width <= _MAX_IMAGE_WIDTH:
        return rgb
    size = (_MAX_IMAGE_WIDTH, round(height * _MAX_IMAGE_WIDTH / width))
    return np.asarray(cv2.resize(rgb, size, interpolation=interpolation), dtype=np.uint8)


def _url(kind: str, rgb: NDArray[np.uint8], parameters: Sequence[int]) -> str:
    _, content = cv2.imencode(f".{kind}", np.ascontiguousarray(rgb[..., ::-1]), parameters)
    return f"data:image/{kind};base64," + base64.b64encode(content.tobytes()).decode()
