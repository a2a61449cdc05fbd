"""The static report: complete, offline, and honest about what is missing."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.charts import Axes, Series, line_chart
from toolkit.runs.evaluation.frame_states import FrameState
from toolkit.runs.evaluation.loop_gallery import LoopPair, LoopPicture
from toolkit.runs.evaluation.loop_poses import EdgeError, edge_metrics
from toolkit.runs.evaluation.metrics import trajectory_metrics
from toolkit.runs.evaluation.report import (
    ReportContent,
    ReportFloorPlan,
    ReportView,
    render_report,
    write_report,
)
from toolkit.runs.evaluation.timing import StageTime
from toolkit.scene.graph.floor_plan import ClassArea


def arc(poses: int = 30) -> Trajectory:
    step = se3.exp(np.array([0.02, 0, 0.03, 0, 0.02, 0]))
    T = np.stack([np.linalg.matrix_power(step, i) for i in range(poses)])
    return Trajectory(np.arange(poses) / 10.0, T)


def full_content() -> ReportContent:
    estimate = arc()
    truth = estimate.transformed(se3.exp(np.array([1.0, 2, 3, 0.5, 0, 0])))
    image = np.full((24, 32, 3), 0.25, np.float32)
    depth_m = np.full((24, 32), 1.5, np.float32)
    return ReportContent(
        title="Room <1>",
        subtitle="30 frames",
        metrics={
            "trajectory": trajectory_metrics(estimate, truth),
            "images": {"mapped": {"psnr_db": 31.5}},
            "map": {"gaussians": 12345},
        },
        estimate=estimate,
        truth=truth,
        lost_at_s=(1.05, 1.15),
        views=(ReportView("frame 3", image, image, depth_m, 0 * depth_m, 33.33),),
        stage_times=(
            StageTime("mapping", 4, 2.0, 500.0),
            StageTime("tracking", 9, 1.0, 1),
        ),
        settings="tracking:\n  iterations: 7\n",
        warnings=("2 of 32 frames have no pose",),
        machine="a machine",
        floor_plan=ReportFloorPlan(
            np.zeros((8, 8, 3), np.uint8), (ClassArea("ta<b>le", 1.234, (1, 2, 3)),)
        ),
    )


def test_the_page_is_one_file_that_works_offline(tmp_path: Path) -> None:
    write_report(tmp_path / "report.html", full_content())
    page = (tmp_path / "report.html").read_text()
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    assert "http" not in page
    assert "<script" not in page
    sources = re.findall(r'(?:src|href)="([^#"][^"]{0,30})', page)
    assert len(sources) == 5
    assert all(re.match(r"data:image/(png|jpeg);base64,", source) for source in sources)


def test_the_page_shows_figures_times_settings_and_warnings() -> None:
    page = render_report(full_content())
    for shown in ("31.50", "12,345", "33.33 dB", "iterations: 7", "2 of 32 frames", "500.0 ms"):
        assert shown in page
    assert "Room &lt;1&gt;" in page
    assert "Room <1>" not in page


def test_loops_show_the_error_of_their_pose_before_their_overlap() -> None:
    image = np.full((24, 32, 3), 0.25, np.float32)
    loops = (LoopPicture(LoopPair(8, 2, True, "12 matches"), image, image),)
    errors = [EdgeError(8, 2, 0.031, 0.5), EdgeError(9, 3, 0.2, 0.1)]
    by_overlap = {"precision_percent": 62.5, "recall_percent": None}
    metrics = {"loops": {"edges": edge_metrics(errors), "verified": {"overlap": by_overlap}}}
    page = render_report(replace(full_content(), metrics=metrics, loops=loops))
    pose, overlap = "1 of 2 accepted edges are right by pose", "precision 62.5 %"
    assert page.index(pose) < page.index(overlap)
    assert "at most 20.0 cm" in page
    assert "accepted edges" not in render_report(replace(full_content(), loops=loops))


def lines_of(svg: str, colour: str) -> list[np.ndarray]:
    """The lines [N, 2] of a colour, in pixels, but those of legends; a gap divides a line."""
    paths = re.findall(rf'd="([^"]+)"[^>]*style="fill: none; stroke: var\(--{colour}\)', svg)
    lines = [line for path in paths for line in path.split("M") if line.count("L") > 2]
    return [np.array(re.findall(r"([-\d.]+) ([-\d.]+)", line), float) for line in lines]


def test_truth_in_another_frame_lies_over_the_estimate() -> None:
    page = render_report(full_content())
    (truth,), (estimate, *_) = lines_of(page, "truth"), lines_of(page, "estimate")
    np.testing.assert_allclose(truth, estimate, atol=0.11)


def test_lost_frames_break_the_error_line_and_are_marked() -> None:
    page = render_report(full_content())
    chart = page[page.index("Error over time") :]
    chart = chart[: chart.index("</svg>")]
    assert len(lines_of(chart, "estimate")) == 2
    assert "frame lost" in chart
    assert len(re.findall(r"<use [^>]*stroke: var\(--alarm\)", chart)) == 2 + 1  # and the legend


def test_drawings_are_the_same_each_time() -> None:
    assert render_report(full_content()) == render_report(full_content())


def test_drawings_have_the_colours_of_the_page() -> None:
    page = render_report(full_content())
    drawings = "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    assert set(re.findall(r"(?:fill|stroke): ([^;\"]+)", drawings)) <= {
        *("none", "var(--soft)", "var(--line)", "var(--ink)", "var(--card)"),
        *("var(--estimate)", "var(--truth)", "var(--alarm)"),
    }


def test_the_strip_covers_the_sequence_and_escapes_reasons() -> None:
    kinds = ["tracked", "lost", "lost", "tracked", "doubtful"]
    parts = [0, None, None, 1, 0]
    states = [
        FrameState(index, kind, "<dark>" if kind == "lost" else "", part)
        for index, (kind, part) in enumerate(zip(kinds, parts, strict=True), start=10)
    ]
    page = render_report(replace(full_content(), states=states))
    sections = re.findall(r'<i class="(\w+)" style="left:([\d.]+)%;width:([\d.]+)%"', page)
    assert sections == [
        ("tracked", "0.000", "20.000"),
        ("lost", "20.000", "40.000"),
        ("other", "60.000", "20.000"),
        ("doubtful", "80.000", "20.000"),
    ]
    assert 'title="frames 11-12, lost: &lt;dark&gt;"' in page and "<dark>" not in page
    assert "States of the frames" not in render_report(full_content())


def test_a_run_without_truth_poses_or_figures_still_has_a_page() -> None:
    nothing = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    page = render_report(ReportContent("Empty", "", {"trajectory": {"ate_rmse_cm": None}}, nothing))
    assert "No frame has a pose" in page
    assert "<svg" not in page
    assert "n/a" in page
    assert ">0.00 <" not in page


def test_depth_without_a_measurement_is_drawn_as_missing() -> None:
    content = full_content()
    view = content.views[0]
    empty = ReportView("x", view.observed_rgb, view.rendered_rgb, *(view.rendered_depth_m,) * 2)
    page = render_report(ReportContent("t", "", {}, content.estimate, views=(empty,)))
    images = re.findall(r'<img src="([^"]+)"', page)
    assert images[2] == images[3]
    assert images[2] != images[0]


def test_equal_axes_draw_a_square_as_a_square() -> None:
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]])
    svg = line_chart([Series(square, "s", "estimate")], Axes("x", "y", equal=True))
    (line,) = lines_of(svg, "estimate")
    width, height = np.ptp(line, axis=0)
    assert width == pytest.approx(height, abs=0.2)


def test_a_camera_that_stood_still_is_drawn() -> None:
    still = Series(np.zeros((5, 2)), "s", "estimate")
    for equal in (True, False):
        assert "var(--estimate)" in line_chart([still], Axes("x", "y", equal=equal))


def test_names_are_shown_as_they_are() -> None:
    svg = line_chart([Series(np.eye(2), "a$1$ <b>", "estimate")], Axes("x", "y"))
    assert "a$1$ &lt;b&gt;" in svg


def test_the_floor_plan_lists_areas_and_is_left_out_without_one() -> None:
    page = render_report(full_content())
    assert "Floor plan" in page
    assert "ta&lt;b&gt;le" in page and "1.23 m²" in page and "rgb(1,2,3)" in page
    assert "Floor plan" not in render_report(replace(full_content(), floor_plan=None))
