"""Pictures of the report: classes by level, loop gallery, graph of the submaps, costs by frame."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest
from labelled_room import TAXONOMY

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import Frustum, observed_points
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.stages import Column
from toolkit.runs.evaluation.frame_costs import (
    FrameCostRecorder,
    FrameCosts,
    memory_chart,
    time_chart,
)
from toolkit.runs.evaluation.loop_gallery import LoopPair, LoopPicture, gallery_pairs
from toolkit.runs.evaluation.report import LevelImage, ReportContent, ReportView, render_report
from toolkit.runs.evaluation.submap_graph import (
    SubmapGraph,
    SubmapLink,
    SubmapViews,
    submap_graph_chart,
    submap_links,
)
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.report_pictures import level_images
from toolkit.semantics.palette import Palette

CAMERA = Camera(40.0, 40.0, 31.5, 23.5, 64, 48)
NOTHING = Trajectory(np.empty(0), np.empty((0, 4, 4)))


def candidate(query: int, match: int, distance: float, accepted: bool = True, reason: str = ""):
    values = {"query": query, "match": match, "query_submap": 1, "match_submap": 0}
    values |= {"distance": distance, "accepted": accepted, "reason": reason}
    return {"kind": "candidate", **values}


def verified(query: int, match: int, accepted: bool = True, reason: str = ""):
    values = {"first": 0, "second": 1, "query": query, "match": match, "apart_m": 0.25}
    return {"kind": "verified", **values, "matches": 40, "accepted": accepted, "reason": reason}


def test_the_gallery_has_accepted_and_the_nearest_rejected_pairs_with_reasons():
    records = [
        candidate(50, 3, 0.4),
        verified(50, 3),
        candidate(60, 4, 0.9),
        verified(60, 4, accepted=False, reason="too few matches"),
        candidate(70, 5, 0.6, accepted=False, reason="landmarks differ"),
        candidate(72, 5, 0.7, accepted=False, reason="nearly the same frame"),
        candidate(90, -4, 0.1),  # a frame of a loaded map has no image here
    ]
    pairs = gallery_pairs(records, 4)
    assert pairs == [
        LoopPair(50, 3, True, "40 matches, cameras 0.25 m apart", 0.4),
        LoopPair(70, 5, False, "landmarks differ", 0.6),
        LoopPair(60, 4, False, "too few matches", 0.9),
    ]
    assert [p.query for p in gallery_pairs(records, 1)] == [50, 70]
    assert gallery_pairs([], 4) == []


def test_an_edge_that_was_removed_later_is_rejected_with_that_reason():
    removed = {"kind": "retracted", "first": 0, "second": 1, "accepted": False}
    records = [candidate(50, 3, 0.4), verified(50, 3), removed | {"reason": "contradicts"}]
    (pair,) = gallery_pairs(records, 4)
    assert not pair.accepted and pair.reason == "contradicts"


def views(number: int, x_m: float, yaw_rad: float = 0.0) -> SubmapViews:
    """A submap with one view of a wall 2 m in front of it."""
    T = se3.exp(np.array([x_m, 0, 0, 0, yaw_rad, 0]))
    points = observed_points(CAMERA, np.full((48, 64), 2.0, np.float32), 200)
    frusta = [Frustum(CAMERA, T, far_m=2.5)]
    return SubmapViews(number, 3, np.array([x_m, 0.0]), se3.transform_points(T, points), frusta)


def test_submaps_are_linked_by_shared_views_and_by_loops():
    submaps = [views(0, 0.0), views(1, 1.0), views(2, 0.0, np.pi)]
    (link,) = submap_links(submaps, [])
    assert (link.first, link.second, link.loop) == (0, 1, False)
    assert 0.5 < link.overlap < 0.8  # of 3.2 m, 2.2 m are shared
    links = submap_links(submaps, [(2, 0)])
    assert {(a.first, a.second, a.loop) for a in links} == {(0, 1, False), (0, 2, True)}


def test_the_graph_draws_submaps_at_one_place_apart():
    submaps = [views(n, 0.0) for n in range(4)]
    links = [SubmapLink(0, 3, 0.5, True)]
    svg = submap_graph_chart(SubmapGraph(submaps, links, np.array([[0.0, 0.0], [2.0, 1.0]])))
    circles = re.findall(
        r'<title>submap \d: 3 keyframes.*?<use [^>]*x="([\d.]+)" y="([\d.]+)"', svg, re.S
    )
    places = np.array(circles, float)
    distances = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(4)
    assert distances.min() > 30.0  # twice the radius
    assert svg.count("submaps 0 and 3: 50 % overlap, loop edge") == 1
    assert all(name in svg for name in ("overlap, wider is more", ">loop edge<"))


def test_costs_are_those_of_each_frame():
    recorder = StageRecorder()
    costs = FrameCostRecorder(recorder)
    for index in (4, 5):
        with costs.frame(index), recorder.timed("tracking"):
            time.sleep(0.002)
    with costs.frame(6), recorder.timed("mapping"):
        pass
    found = costs.costs()
    assert found.frames.tolist() == [4, 5, 6]
    tracking_ms, mapping_ms = (found.columns_ms[c] for c in (Column.TRACKING, Column.MAPPING))
    assert (tracking_ms[:2] >= 2.0).all() and tracking_ms[2] == 0.0
    assert mapping_ms[:2].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(tracking_ms.sum(), recorder.total_ms("tracking"))
    assert (found.total_ms >= tracking_ms + mapping_ms).all()


def some_costs(count: int) -> FrameCosts:
    total = np.full(count, 50.0)
    total[count // 2] = 9000.0
    half, memory = np.full(count, 20.0), np.linspace(100, 200, count)
    columns = dict.fromkeys(Column, half)
    return FrameCosts(np.arange(count), total, columns, memory)


def test_a_slow_frame_is_marked_and_does_not_flatten_the_chart():
    svg = time_chart(some_costs(300))
    assert "longer, up to 9000 ms" in svg
    assert len(re.findall(r"<use [^>]*stroke: var\(--alarm\)", svg)) == 1 + 1  # and the legend
    ticks = [float(tick) for tick in re.findall(r">(\d+)</text>", svg)]
    assert max(ticks) < 400.0  # frames to 299, times to 50 ms
    (path,) = (p for p in re.findall(r'd="([^"]+)"[^>]*var\(--truth\)', svg) if p.count("L") > 2)
    assert path.count("M") == 2  # the gap divides the line


def test_charts_of_long_runs_stay_small_and_empty_ones_are_left_out():
    assert len(time_chart(some_costs(30_000))) < 60_000
    assert "every 50 frames" in memory_chart(some_costs(30_000))
    nothing = FrameCostRecorder(StageRecorder()).costs()
    assert time_chart(nothing) == memory_chart(nothing) == ""
    unknown = replace(some_costs(5), memory_mb=np.full(5, np.nan))
    assert memory_chart(unknown) == ""


def test_levels_show_their_classes_from_coarse_to_fine():
    nodes = [np.full((6, 8), TAXONOMY.node_ids[0, level]) for level in range(TAXONOMY.depth)]
    levels = level_images(Palette(TAXONOMY), nodes)
    assert [level.name for level in levels] == list(TAXONOMY.levels)
    for level, node_ids in zip(levels, nodes, strict=True):
        assert level.legend[0].colour == tuple(level.image[0, 0])
        assert TAXONOMY.nodes[node_ids[0, 0]].name in level.legend[0].text


@pytest.fixture
def page() -> str:
    image, depth_m = np.full((24, 32, 3), 0.25), np.full((24, 32), 1.5)
    level = LevelImage("si<z>e", np.zeros((24, 32, 3), np.uint8), level_legend())
    view = ReportView("frame 3", image, image, depth_m, depth_m, 33.3, [level])
    pair = LoopPair(50, 3, False, "too <few> matches", 0.4)
    content = ReportContent(
        "Room",
        "",
        {},
        NOTHING,
        views=[view],
        loops=[LoopPicture(pair, image, image)],
        submaps=SubmapGraph([views(0, 0.0), views(1, 1.0)], [], np.zeros((2, 2))),
        costs=some_costs(20),
    )
    return render_report(content)


def level_legend():
    image = np.arange(8)[None] % len(TAXONOMY.nodes)
    return Palette(TAXONOMY).legend(image)


def test_the_page_contains_all_pictures_inline(page: str):
    for heading in ("Loops", "Submaps", "Time of each frame", "classes from coarse to fine"):
        assert heading in page
    assert "too &lt;few&gt; matches" in page and "si&lt;z&gt;e" in page
    assert "and 3 more" in page
    assert "http" not in page and "<script" not in page
    sources = re.findall(r'src="([^"]{0,16})', page)
    assert len(sources) == 4 + 1 + 2
    assert {source[:11] for source in sources} == {"data:image/"}


def test_parts_without_content_are_left_out():
    page = render_report(ReportContent("Room", "", {}, NOTHING))
    for heading in ("Loops", "Submaps", "Time of each frame", "Memory of the process"):
        assert heading not in page
