"""Scene graphs that grow during a run: time per keyframe, and distance from the finished graph.

SEMSPLAT_DATA=DATA python -m benchmarks.semantics.growing_scene [--seeds 1]
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.shared.recordings import RECORDINGS, room
from benchmarks.shared.runner import Page
from benchmarks.shared.runs import finished_slam
from benchmarks.shared.tables import Metrics, Rows, Table, table_of
from toolkit.base.stages import Stage
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_dataset
from toolkit.exports.mapped_scene import map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.scene_graph import scene_graph
from toolkit.exports.selection import select
from toolkit.runs.settings import RunSettings
from toolkit.scene.growing.listener import scene_graph_of
from toolkit.scene.growing.options import GrowingSceneOptions

SEQUENCES = {"room": "room-objects", "office0": "office0", "ring": "ring-small"}
KINDS = ("on", "in", "above", "facing", "next to", "part of", "connected to")
TIMES = ("keyframes", "median_ms", "p95_ms", "max_ms", "nodes", "finished_nodes", "same_nodes")
SCORES = ("grown", "finished", "precision", "recall")
# Objects of both graphs are one if they have the same class, and the centres of their boxes differ
# by less.
_SAME_M = 0.4
DESCRIPTION = """\
`semsplat run --scene.graph` with given poses on room (120 frames, 320x240, sensor noise), office0
(51 views of Replica) and ring (450 frames, 160x120, sensor noise, a loop). The time is that of the
stage "scene graph" for frames that became keyframes, on one core; labels come from the dataset.

The second table compares the graph with that of the finished map: relations of nodes that both
graphs have, in percent of those of the growing graph (precision) and of the finished one (recall).
Nodes are the same if they have one class and the centres of their boxes are at most 0.4 m apart;
rooms by their number."""


def tables(found: Rows) -> list[Table]:
    """Times, and a row for each kind of relation of each sequence."""
    rows: Rows = {
        f"{name}: {kind}": [run["relations"][kind] for run in runs]
        for name, runs in found.items()
        for kind in KINDS
        if any(run["relations"][kind]["finished"] for run in runs)
    }
    return [
        table_of(TIMES, found, title="Time"),
        table_of(SCORES, rows, title="Distance from the finished graph"),
    ]


def measure(name: str, seed: int) -> Metrics:
    """Times and relations of a sequence."""
    settings = _settings(name, seed)
    assert settings.dataset.path is not None
    dataset = open_dataset(settings.dataset.kind, settings.dataset.path, settings.image_size)
    with finished_slam(settings, dataset) as run:
        times_ms = run.watch.durations_ms[Stage.SCENE_GRAPH]
        assert len(times_ms) == len(dataset)
        spent_ms = [times_ms[index] for index in run.result.keyframe_indices]
        scene = map_scene(select(run.path), ObjectGraphOptions())
        grown = scene_graph_of(run.result)
        assert grown is not None
        compared = _compared(grown, scene_graph(scene).content)
    return compared | {
        "keyframes": len(spent_ms),
        "median_ms": float(np.median(spent_ms)),
        "p95_ms": float(np.percentile(spent_ms, 95)),
        "max_ms": max(spent_ms),
    }


def _settings(name: str, seed: int) -> RunSettings:
    scene = GrowingSceneOptions(graph=True)
    if name == "office0":
        dataset = DatasetOptions(kind="replica", path=RECORDINGS[name].path)
        return RunSettings(dataset=dataset, image_size=(300, 170), poses="given", scene=scene)
    dataset = DatasetOptions(kind="synthetic", path=room(SEQUENCES[name], seed))
    return RunSettings(dataset=dataset, seed=seed, poses="given", scene=scene)


def _compared(grown: dict[str, Any], finished: dict[str, Any]) -> Metrics:
    same = _same_nodes(grown["nodes"], finished["nodes"])
    known = {node["id"]: node["id"] for node in finished["nodes"]}
    relations = {}
    for kind in KINDS:
        own, others = _edges(grown, kind, same), _edges(finished, kind, known)
        others = {pair for pair in others if set(pair) <= set(same.values())}
        hits = len(own & others)
        relations[kind] = {
            "grown": len(own),
            "finished": len(others),
            "precision": 100.0 * hits / len(own) if own else None,
            "recall": 100.0 * hits / len(others) if others else None,
        }
    counts = {"nodes": len(grown["nodes"]), "finished_nodes": len(finished["nodes"])}
    return {"relations": relations, **counts, "same_nodes": len(set(same.values()))}


def _same_nodes(grown: list[dict[str, Any]], finished: list[dict[str, Any]]) -> dict[int, int]:
    """The node of the finished graph of each node of the growing one that has one."""
    same = {}
    for node in grown:
        others = [o for o in finished if o["name"] == node["name"]]
        gaps = [_gap_m(node, other) for other in others]
        if gaps and min(gaps) <= _SAME_M:
            same[node["id"]] = others[int(np.argmin(gaps))]["id"]
    return same


def _gap_m(node: dict[str, Any], other: dict[str, Any]) -> float:
    if "box" not in node:  # rooms and storeys
        return 0.0
    centres = (np.array(n["box"]["centre_m"]) for n in (node, other))
    return float(np.linalg.norm(np.subtract(*centres)))


def _edges(graph: dict[str, Any], kind: str, names: Mapping[int, int]) -> set[tuple[int, int]]:
    found = set()
    for edge in graph["edges"]:
        ends = edge["source"], edge["target"]
        if edge["relation"] != kind or not all(end in names for end in ends):
            continue
        a, b = (names[end] for end in ends)
        if a != b:
            found.add((min(a, b), max(a, b)) if kind in ("next to", "connected to") else (a, b))
    return found


PAGE = Page(
    "growing_scene",
    "Growing scene graphs",
    DESCRIPTION,
    {name: name for name in SEQUENCES},
    measure,
    tables,
)

if __name__ == "__main__":
    PAGE.main()
