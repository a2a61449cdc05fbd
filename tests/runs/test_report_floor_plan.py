"""The report of a run with labels contains its floor plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from labelled_room import TAXONOMY, gaussians_at, labelled, room_parts

from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io.length_names import METRES
from toolkit.io.splats import write_splat_ply
from toolkit.runs.evaluation.report import ReportContent, render_report
from toolkit.runs.report_pictures import report_floor_plan

EMPTY_PATH = Trajectory(np.empty(0), np.empty((0, 4, 4)))


def test_a_run_with_labels_reports_its_floor_plan(tiny_run):
    page = (tiny_run / "report.html").read_text()
    assert "<h2>Floor plan</h2>" in page
    assert "area from above" in page


def test_a_run_reports_its_classes_and_the_costs_of_its_frames(tiny_run):
    page = (tiny_run / "report.html").read_text()
    for heading in ("classes from coarse to fine", "Time of each frame", "Memory of the process"):
        assert heading in page
    assert "<h2>Submaps</h2>" not in page  # there is only one
    assert len(page) < 1_000_000


def test_maps_without_labels_or_without_a_floor_have_none(tmp_path):
    points_m, labels = labelled(room_parts())
    gaussians = gaussians_at(points_m, labels.label)
    cameras_m = np.zeros((2, 3))
    write_splat_ply(tmp_path / "map.ply", gaussians, labels.columns())
    plan = report_floor_plan(tmp_path / "map.ply", TAXONOMY, cameras_m, METRES)
    assert plan.areas[0].name == "floor"
    write_splat_ply(tmp_path / "bare.ply", gaussians)
    assert report_floor_plan(tmp_path / "bare.ply", TAXONOMY, cameras_m, METRES) is None
    points_m, part_labels = labelled({"table": room_parts()["table"]})
    part = gaussians_at(points_m, part_labels.label)
    write_splat_ply(tmp_path / "table.ply", part, part_labels.columns())
    assert report_floor_plan(tmp_path / "table.ply", TAXONOMY, cameras_m, METRES) is None
    faint = gaussians.opacity_logits - torch.tensor(9.0)
    write_splat_ply(
        tmp_path / "faint.ply", replace(gaussians, opacity_logits=faint), labels.columns()
    )
    assert report_floor_plan(tmp_path / "faint.ply", TAXONOMY, cameras_m, METRES) is None


def test_a_scene_graph_is_drawn_over_the_plan_and_listed(tmp_path):
    points_m, labels = labelled(room_parts())
    write_splat_ply(tmp_path / "map.ply", gaussians_at(points_m, labels.label), labels.columns())
    box = {"centre_m": points_m.mean(axis=0).tolist()}
    graph = {
        "nodes": [
            {"id": 3, "kind": "object", "name": "<b>table", "box": box},
            {"id": 4, "kind": "structure", "name": "floor", "box": box},
            {"id": 5, "kind": "room", "name": "room 1", "centre_m": box["centre_m"], "doors": []},
        ],
        "edges": [
            {"source": 3, "target": 4, "relation": "on"},
            {"source": 3, "target": 5, "relation": "in"},
        ],
    }
    arguments = (tmp_path / "map.ply", TAXONOMY, np.zeros((2, 3)), METRES)
    plain, drawn = report_floor_plan(*arguments), report_floor_plan(*arguments, graph)
    assert (plain.image != drawn.image).any()
    assert plain.objects == ()
    assert drawn.objects == [("3", "<b>table", "on floor (4), in room 1")]
    page = render_report(ReportContent("run", "", {}, EMPTY_PATH, floor_plan=drawn))
    assert "&lt;b&gt;table" in page
    assert "<b>table" not in page
