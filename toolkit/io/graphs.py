"""Graphs of objects as JSON-LD and GraphML, from the node-link format of NetworkX."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from typing import Any

# Identifiers that need no server: a context is in the file.
_VOCABULARY = "urn:semsplat:"
_GRAPHML = "http://graphml.graphdrawing.org/xmlns"
# Characters that XML 1.0 does not allow.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_TYPES = {bool: "boolean", int: "long", float: "double"}


def graph_bytes(content: dict[str, Any], suffix: str) -> bytes:
    """Return a graph as a file: .graphml, .jsonld, else JSON in node-link format.

    Characters that UTF-8 lacks are "?".
    """
    if suffix == ".graphml":
        return graphml_bytes(content)
    values = json_ld(content) if suffix == ".jsonld" else content
    text = json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode(errors="replace")


def json_ld(content: dict[str, Any]) -> dict[str, Any]:
    """Return a graph as a JSON-LD 1.1 document.

    Nodes are `node/ID` with their kind as type. Each relation is a property named in camel case
    (`nextTo`) whose values are nodes. Lists keep their order.
    """
    relations = sorted({edge["relation"] for edge in content["edges"]})
    properties = {name: {"@id": name, "@type": "@id"} for name in map(_camel, relations)}
    lists = {
        key: {"@id": key, "@container": "@list"}
        for node in [content["graph"], *content["nodes"]]
        for key, value in node.items()
        # JSON-LD has no lists of dictionaries with lists of lists: these are JSON literals.
        if isinstance(value, list)
    }
    literals = {key: {"@id": key, "@type": "@json"} for key in ("box", "doors")}
    context = {
        "@version": 1.1,
        "@vocab": _VOCABULARY,
        "@base": f"{_VOCABULARY}scene/",
        "name": "http://schema.org/name",
        **lists,
        **literals,
        **properties,
    }
    nodes = []
    for node in content["nodes"]:
        values = {key: value for key, value in node.items() if key not in ("id", "kind")}
        nodes.append(
            {"@id": f"node/{node['id']}", "@type": _camel(node["kind"]).capitalize(), **values}
        )
    by_id = {node["id"]: values for node, values in zip(content["nodes"], nodes, strict=True)}
    for edge in content["edges"]:
        targets = by_id[edge["source"]].setdefault(_camel(edge["relation"]), [])
        targets.append(f"node/{edge['target']}")
    return {"@context": context, "@id": "graph", **content["graph"], "nodes": nodes}


def _camel(words: str) -> str:
    first, *rest = words.split()
    return first + "".join(word.capitalize() for word in rest)


def graphml_bytes(content: dict[str, Any]) -> bytes:
    """Return a graph as GraphML. Nested values are JSON texts; characters XML lacks are "?"."""
    root = ET.Element("graphml", xmlns=_GRAPHML)
    graph = ET.Element("graph", id="scene", edgedefault="directed")
    keys: dict[tuple[str, str], ET.Element] = {}

    def add_data(element: ET.Element, scope: str, values: dict[str, Any]) -> None:
        for name, value in values.items():
            if value is None:
                continue
            key = keys.setdefault(
                (scope, name),
                ET.Element(
                    "key",
                    {
                        "id": f"{scope}_{name}",
                        "for": scope,
                        "attr.name": name,
                        "attr.type": _TYPES.get(type(value), "string"),
                    },
                ),
            )
            ET.SubElement(element, "data", key=key.attrib["id"]).text = _text(value)

    add_data(graph, "graph", content["graph"])
    for node in content["nodes"]:
        element = ET.SubElement(graph, "node", id=str(node["id"]))
        add_data(element, "node", {k: v for k, v in node.items() if k != "id"})
    for number, edge in enumerate(content["edges"]):
        ends = {end: str(edge[end]) for end in ("source", "target")}
        element = ET.SubElement(graph, "edge", {"id": f"e{number}", **ends})
        values = {k: v for k, v in edge.items() if k not in ("source", "target", "key")}
        add_data(element, "edge", values)
    root.extend(keys.values())
    root.append(graph)
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return _NOT_XML.sub("?", text)
