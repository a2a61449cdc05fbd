"""Options of the scene graph that grows during a run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GrowingSceneOptions:
    """The scene graph of a run while the camera moves. It needs class labels."""

    graph: bool = False
    """Keep objects, their relations, rooms and storeys up to date with every keyframe, and write
    them to scene_graph.json, .jsonld and .graphml. Objects are those of --instances if they are
    on, else connected surfaces of one class."""
