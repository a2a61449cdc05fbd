"""Floor plans of the labelled room: what is where, how large, and which way round."""

from __future__ import annotations

import numpy as np
import pytest
from labelled_room import IDS, LENGTH_M, TAXONOMY, WIDTH_M, labelled, room_parts

from toolkit.scene.graph.floor_plan import (
    PlanDrawing,
    PlanEdge,
    PlanNode,
    draw_floor_plans,
    floor_plans,
)
from toolkit.scene.query import LabelledMap
from toolkit.semantics.palette import Palette


@pytest.fixture(scope="module")
def plan():
    points_m, labels = labelled(room_parts())
    room = LabelledMap(points_m, labels, TAXONOMY)
    radii_m = np.full(len(points_m), 0.03)
    cameras_m = points_m[labels.label == IDS["table"]][:2]
    (found,) = floor_plans(room, radii_m, room.floors(), cameras_m, Palette(TAXONOMY))
    return found


def test_areas_are_those_of_the_room(plan):
    areas = {area.name: area.area_m2 for area in plan.areas}
    assert list(areas)[:2] == ["floor", "table"]
    assert areas["floor"] == pytest.approx(LENGTH_M * WIDTH_M, rel=0.03)
    assert areas["table"] == pytest.approx(1.2 * 0.8, rel=0.1)


def test_the_highest_class_is_shown_without_gaps_and_along_the_walls(plan):
    filled = plan.class_ids >= 0
    rows, columns = (np.flatnonzero(filled.any(axis=axis)) for axis in (1, 0))
    sides = np.array([np.ptp(rows), np.ptp(columns)]) * plan.pixel_m
    np.testing.assert_allclose(sorted(sides), [WIDTH_M, LENGTH_M], atol=0.15)
    inside = plan.class_ids[rows[0] : rows[-1], columns[0] : columns[-1]]
    assert (inside >= 0).mean() > 0.99
    # The board hides the floor below it.
    table = (plan.class_ids == IDS["table"]).sum() * plan.pixel_m**2
    # Discs reach two pixels beyond the centres on every side.
    assert table == pytest.approx((1.2 + 0.08) * (0.8 + 0.08), rel=0.05)


def test_the_path_is_drawn_where_the_camera_was(plan):
    column, row = plan.path[0].astype(int)
    assert plan.class_ids[row, column] == IDS["table"]


def test_the_legend_can_be_left_out(plan):
    palette = Palette(TAXONOMY)
    bare, whole = (draw_floor_plans([plan], palette, legend) for legend in (False, True))
    assert bare.shape[1] < whole.shape[1]
    np.testing.assert_array_equal(bare, whole[:, : bare.shape[1]])


def test_a_graph_is_drawn_between_its_objects(plan):
    places = np.zeros((2, 3))
    inverse = np.linalg.pinv(plan.T_pixels_map[:, :3])
    height, width = plan.class_ids.shape
    for place, share in zip(places, (0.25, 0.75), strict=True):
        pixel = np.array([share * width, height / 2])
        place[:] = inverse @ (pixel - plan.T_pixels_map[:, 3])
    nodes = [PlanNode(str(k), place) for k, place in enumerate(places)]
    none = np.empty((0, 3))
    drawings = [
        PlanDrawing([], none, none, none, nodes, [PlanEdge(kind, *places)] if kind else [])
        for kind in ("", "on", "facing")
    ]
    palette = Palette(TAXONOMY)
    bare, on, facing = (
        draw_floor_plans([plan], palette, legend=False, drawings=[d]) for d in drawings
    )
    middle = np.s_[bare.shape[0] // 2, bare.shape[1] // 2]
    assert (bare[middle] != on[middle]).any() and (on[middle] != facing[middle]).any()
    legend = draw_floor_plans([plan], palette, drawings=drawings[1:2])
    assert legend.shape[1] > bare.shape[1]
