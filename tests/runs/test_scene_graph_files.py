"""The files of a scene graph that grew during a run."""

from __future__ import annotations

import json
import logging

import pytest

from toolkit.runs.folder import RunFolder
from toolkit.runs.results import write_scene_graph
from toolkit.scene.graph.node_link import graph_edge

CONTENT = {
    "directed": True,
    "multigraph": True,
    "graph": {"up": [0.0, 0.0, 1.0], "storeys_m": [0.0]},
    "nodes": [{"id": k, "kind": "object", "name": f"<b>{k}"} for k in range(2)],
    "edges": [graph_edge(0, 1, "on")],
}


@pytest.mark.parametrize(("metric", "unit"), [(True, "metres"), (False, "arbitrary units")])
def test_all_formats_state_the_unit_and_the_origin(tmp_path, metric, unit):
    folder = RunFolder(tmp_path)
    write_scene_graph(folder, CONTENT, metric, {"origin_m": [1.0, 2.0, 3.0]})
    graph = json.loads(folder.scene_graph.read_text())["graph"]
    assert graph["metric"] is metric and graph["frame"].endswith(unit)
    assert graph["map_origin_m"] == [1.0, 2.0, 3.0] and graph["up"] == [0.0, 0.0, 1.0]
    for suffix in (".jsonld", ".graphml"):
        text = folder.scene_graph.with_suffix(suffix).read_text()
        assert unit in text and str(metric).lower() in text


def test_a_run_without_floor_says_that_it_has_no_graph(tmp_path, caplog):
    folder = RunFolder(tmp_path)
    with caplog.at_level(logging.WARNING):
        write_scene_graph(folder, None, True, {})
    assert "No scene graph was written, because no floor was found" in caplog.text
    assert not folder.scene_graph.exists()
