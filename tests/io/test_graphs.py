"""Graphs in XML and JSON-LD survive hostile text and nested values."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

from toolkit.io.graphs import graph_bytes, graphml_bytes, json_ld

CONTENT = {
    "graph": {"metric": True, "up": [0.0, 0.0, 1.0]},
    "nodes": [
        {"id": 0, "kind": "object", "name": "</node><script>\x1b[31m&\ud800", "n": 3, "none": None},
        {"id": 1, "kind": "room", "name": "room 1", "n": 0.5, "doors": [{"width_m": 0.9}]},
    ],
    "edges": [
        {"source": 0, "target": 1, "key": "part of", "relation": "part of"},
        {"source": 1, "target": 1, "key": "connected to", "relation": "connected to"},
    ],
}


def test_graphml_is_well_formed_and_typed():
    root = ET.fromstring(graphml_bytes(CONTENT))
    space = {"g": "http://graphml.graphdrawing.org/xmlns"}
    keys = {k.get("id"): k.get("attr.type") for k in root.findall("g:key", space)}
    assert keys["graph_metric"] == "boolean" and keys["node_n"] == "long"
    assert keys["node_doors"] == "string"
    first, second = root.findall("g:graph/g:node", space)
    texts = {d.get("key"): d.text for d in first}
    assert texts["node_name"] == "</node><script>?[31m&?" and "node_none" not in texts
    texts = {d.get("key"): d.text for d in second}
    assert json.loads(texts["node_doors"]) == [{"width_m": 0.9}]


def test_json_ld_links_nodes_by_relations():
    content = json_ld(CONTENT)
    first, second = content["nodes"]
    assert first["@type"] == "Object" and first["partOf"] == ["node/1"]
    assert second["connectedTo"] == ["node/1"]
    assert content["@context"]["partOf"]["@type"] == "@id"
    # Nested values cannot be lists of JSON-LD.
    assert content["@context"]["doors"]["@type"] == "@json"
    assert content["@context"]["up"]["@container"] == "@list"


def test_the_suffix_selects_the_format_and_any_name_can_be_written():
    node_link = json.loads(graph_bytes(CONTENT, ".json"))
    assert node_link["nodes"][0]["name"] == "</node><script>\x1b[31m&?"
    assert node_link["edges"] == CONTENT["edges"]
    linked = json.loads(graph_bytes(CONTENT, ".jsonld"))
    assert linked["nodes"][1]["connectedTo"] == ["node/1"]
    assert graph_bytes(CONTENT, ".graphml") == graphml_bytes(CONTENT)
