"""Loop closure from candidates to corrections (G-III.C): verify, optimise the graph, move anchors.

Loops are closed when a submap ends, and once more at the end of the run. Inside a submap, edges
are estimated from the images of two keyframes, and keyframes are moved together with the Gaussians
they seeded. Between submaps, edges are estimated by registration, and only anchors are moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import NullRecorder, Recorder
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.stages import Stage
from toolkit.io.arrays import arrays_below
from toolkit.slam.loops.candidates import LoopCandidate
from toolkit.slam.loops.closing.anchor_graph import AnchorGraph
from toolkit.slam.loops.closing.image_edges import ImageEdges, ImageLoops
from toolkit.slam.loops.closing.interface import LoopClosing
from toolkit.slam.loops.closing.keyframe_loops import KeyframeLoops
from toolkit.slam.loops.closing.log_entries import motion_values
from toolkit.slam.loops.closing.options import ClosingOptions
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.submap_loops import SubmapLoops
from toolkit.slam.loops.closing.uncertainty import PathPose
from toolkit.slam.loops.detection import LoopDetector
from toolkit.slam.loops.log import LoopLog
from toolkit.slam.loops.relocalisation import Relocalisation, Relocaliser
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.reach import Reach

Array = NDArray[np.float64]

# Number of similar keyframes that a doubtful frame is matched with.
_SIMILAR = 4


class LoopCloser(LoopClosing):
    """Finds loops during a run and corrects the atlas; see `LoopClosing`.

    Args:
        log: receives each candidate and each decision; None disables it.
    """

    def __init__(
        self,
        detector: LoopDetector,
        parts: ClosingParts,
        options: ClosingOptions | None = None,
        log: LoopLog | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.options = options or ClosingOptions()
        self._detector, self._parts, self._log = detector, parts, log
        self._recorder = recorder or NullRecorder()
        self._graph = AnchorGraph(parts, self._record)
        self._pending: list[LoopCandidate] = []
        self._deferred = False
        self._between = SubmapLoops(parts, self.options, self._record)
        self._images = ImageLoops(parts, self._record)

    @property
    def loops(self) -> Sequence[PoseEdge]:
        """The accepted loop edges between submaps."""
        return self._graph.loops

    def similar_keyframes(self, atlas: Atlas, view: Keyframe) -> list[Keyframe]:
        """Keyframes of the active submap that look most similar to a view; see `LoopClosing`."""
        keyframes = {keyframe.index: keyframe for keyframe in atlas.keyframes}
        found = self._detector.most_similar(view, _SIMILAR)
        return [keyframes[s.frame] for s in found if s.frame in keyframes]

    def map_loaded(self, atlas: Atlas) -> None:
        """Add the keyframes and the anchors of a loaded map, which is treated as rigid."""
        self._detector.add_saved_submaps(atlas.submap(number) for number in range(atlas.saved))
        self._graph.odometry.map_loaded(atlas)

    def defer(self) -> None:
        """Close loops between submaps in `finish` only, because registration takes long."""
        self._deferred = True

    def keyframe_added(self, atlas: Atlas) -> None:
        """Search for loops at the newest keyframe of the active submap."""
        with self._recorder.timed(Stage.LOOP_DETECTION):
            considered = self._detector.observe(atlas)
        if self._detector.searched:
            query = atlas.keyframes[-1].index
            self._record("search", {"query": query, "considered": len(considered)})
        for candidate in considered:
            self._record("candidate", candidate.record())
        self._pending += [c for c in considered if c.accepted]

    def submap_ending(self, atlas: Atlas, mapper: Mapper) -> Array | None:
        """Close the loops inside the active submap; see `LoopClosing`."""
        keyframes = atlas.keyframes
        if not keyframes:
            return None
        T_map_camera = keyframes[-1].T_map_camera
        if not self.close_within(atlas, mapper):
            return None
        return atlas.keyframes[-1].T_map_camera @ se3.inverse(T_map_camera)

    def submap_started(self, atlas: Atlas, ended: int, information: Array) -> None:
        """Add the odometry edge to the new submap, and close the loops of the previous submap."""
        self._graph.odometry.started(atlas, ended, information)
        self._submap_ended(atlas, ended)

    def submap_recovered(
        self, atlas: Atlas, ended: int, found: Relocalisation | None, reach: Reach | None = None
    ) -> None:
        """Connect a submap that started at a lost frame, and close the previous submap's loops."""
        self._connect(atlas, found, reach)
        self._submap_ended(atlas, ended)
        self.keyframe_added(atlas)

    def enterable(self, atlas: Atlas) -> list[int]:
        """Numbers of the submaps that the camera may have entered; see `LoopClosing`."""
        return self._graph.enterable(atlas)

    def origin(self, atlas: Atlas) -> int | None:
        """Number of the submap in which the active one started; see `LoopClosing`."""
        return self._graph.odometry.origins.get(atlas.active)

    def submap_entered(
        self, atlas: Atlas, ended: int, T_ended_camera: Array, found: Relocalisation
    ) -> None:
        """Remember the way back from the newest submap, and close the loops of the previous one.

        If it has none with the submap that was entered, the common frame becomes one.
        """
        step = self._graph.odometry.entered(atlas, ended, T_ended_camera, found)
        self._submap_ended(atlas, ended)
        if self._deferred or not self.options.between:
            return
        pair = {found.submap, ended}
        if any({edge.first, edge.second} == pair for edge in self._graph.known):
            return
        step = step if step.first < step.second else step.inverted()
        loop = PoseEdge.loop(step.first, step.second, step.T_first_second, step.information)
        self._graph.loops.append(loop)
        values = {"first": loop.first, "second": loop.second}
        self._record("entered", values | {"visible": found.result.visible_fraction})
        with self._recorder.timed(Stage.LOOPS_BETWEEN):
            self._graph.correct(atlas)

    def _submap_ended(self, atlas: Atlas, number: int) -> None:
        """Close the loops of a submap that is no longer active, unless this is deferred."""
        if not self._deferred:
            self.close_between(atlas, number)
        self._graph.odometry.ended.add(number)

    def finish(self, atlas: Atlas, mapper: Mapper) -> None:
        """Close all remaining loops, and register overlapping submaps once more."""
        # Before refinement, which changes the map that frames and submaps are registered against.
        self.submap_ending(atlas, mapper)
        for number in sorted({c.query_submap for c in self._pending} | {atlas.active}):
            self.close_between(atlas, number)
        if not mapper.options.final_anchors:
            self.register_overlaps(atlas)

    def close_within(self, atlas: Atlas, mapper: Mapper) -> bool:
        """Close the loops inside the active submap; return whether its keyframes moved."""
        number = atlas.active
        candidates = [c for c in self._pending if c.query_submap == c.match_submap == number]
        self._pending = [c for c in self._pending if c not in candidates]
        if not candidates or not self.options.within:
            return False
        with self._recorder.timed(Stage.LOOPS_WITHIN):
            loops = KeyframeLoops(self._parts, self.options, self._record)
            return loops.close(atlas.current, mapper, candidates)

    def _connect(self, atlas: Atlas, found: Relocalisation | None, reach: Reach | None) -> None:
        """Add the edges of a submap that started at a lost frame.

        Its odometry is interrupted, so its pose relative to the previous submap is uncertain. If
        the frame was relocalised in a submap, the relocalisation becomes a loop edge.
        """
        self._graph.odometry.started_lost(atlas, None if found is None else found.submap, reach)
        new = atlas.active
        if found is None:
            return
        result = found.result
        edge = self._parts.loop_noise.edge(
            found.submap, new, result.T_map_camera, result.information
        )
        self._graph.loops.append(edge)
        values = {"first": found.submap, "second": new, "visible": result.visible_fraction}
        self._record("found", values | _found_motion(atlas, found))

    @property
    def relocaliser(self) -> Relocaliser:
        """Relocalises lost frames."""
        return self._parts.relocaliser

    def close_between(self, atlas: Atlas, number: int) -> bool:
        """Close the loops of one submap with older submaps; return whether anchors moved."""
        candidates = [c for c in self._pending if c.query_submap == number != c.match_submap]
        self._pending = [c for c in self._pending if c not in candidates]
        if not candidates or not self.options.between:
            return False
        with self._recorder.timed(Stage.LOOPS_BETWEEN):
            found = False
            # After a relocalisation, two submaps have a loop edge before they are registered.
            existing = self._graph.by_pair
            links = self._graph.odometry.links
            by_objects = self._between.suspected_by_objects(atlas, number, candidates, links)
            suspected = {c.match_submap for c in candidates} | by_objects
            if number in self._graph.odometry.ended and not self._deferred:
                # The camera was here again.
                suspected -= {n for pair in existing if number in pair for n in pair}
            images: Mapping[int, ImageEdges | None] = dict.fromkeys(sorted(suspected))
            if self._parts.verification is not None:
                images = self._images.unambiguous(
                    atlas, number, suspected, self._graph.parts(atlas), candidates, links
                )
            for other, found_by_images in images.items():
                edge = existing.get((other, number)) or existing.get((number, other))
                new = self._between.close(
                    atlas, (other, number), candidates, links, found_by_images
                )
                if new is None and edge is not None:
                    pairs = [(c.query, c.match) for c in candidates if c.match_submap == other]
                    self._between.confirm(atlas, edge, pairs)
                if new is not None:
                    self._graph.loops.append(new if other < number else new.inverted())
                    found = True
            return found and self._graph.correct(atlas)

    def register_overlaps(self, atlas: Atlas) -> bool:
        """Register all overlapping finished submaps again.

        Stage 2 of G moves the anchors by gradient descent on renderings of the joint map
        (`refinement/anchors.py`). Registration of each overlapping pair optimises the same
        alignment with second-order steps, and its results can be weighted and rejected.

        Returns:
            Whether anchors moved.
        """
        if not self.loops or not self.options.between:
            return False
        with self._recorder.timed(Stage.ANCHOR_REGISTRATION):
            existing = self._graph.by_pair
            registered, parts = [], self._graph.parts(atlas)
            for first, second in self._between.overlapping(atlas, set(existing), parts):
                edge = self._between.register(atlas, first, second, self._graph.odometry.links)
                edge = edge or existing.get((first, second))
                registered += [] if edge is None else [edge]
            self._graph.loops = registered
            moved = self._graph.correct(atlas)
            return self._register_neighbours(atlas) or moved

    def _register_neighbours(self, atlas: Atlas) -> bool:
        """Register neighbours without a loop edge once more, starting at their corrected poses.

        Without an edge of their own, the drift between two neighbours would only be distributed
        over the graph.
        """
        connected = {(loop.first, loop.second) for loop in self.loops}
        missing = [pair for pair in self._between.neighbours(atlas) if pair not in connected]
        edges = [
            self._between.register_neighbours(atlas, *pair, self._graph.odometry.links)
            for pair in missing
        ]
        new = [edge for edge in edges if edge is not None]
        self._graph.loops += new
        return bool(new) and self._graph.correct(atlas)

    def parts(self, atlas: Atlas) -> list[tuple[int, ...]]:
        """Submaps with known relative poses; see `LoopClosing`."""
        return self._graph.parts(atlas)

    def covariances(self, atlas: Atlas, path: Sequence[PathPose]) -> Array:
        """Covariances of frame poses; see `frame_covariances`."""
        return self._graph.covariances(atlas, path)

    def _record(self, kind: str, values: dict[str, Any]) -> None:
        if self._log is not None:
            self._log.write({"kind": kind, **values})

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values for `restore`."""
        arrays, values = self._graph.state()
        arrays |= {f"detector/{name}": array for name, array in self._detector.state().items()}
        if self._parts.objects is not None:
            known = self._parts.objects.state()
            arrays |= {f"objects/{name}": array for name, array in known.items()}
        values["suspected"] = [asdict(candidate) for candidate in self._pending]
        values["log_bytes"] = None if self._log is None else self._log.size_bytes
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`, and truncate the log to its size at that time."""
        self._detector.restore(arrays_below(arrays, "detector/"))
        if self._parts.objects is not None:
            self._parts.objects.restore(arrays_below(arrays, "objects/"))
        self._graph.restore(arrays, values)
        self._pending = [LoopCandidate(**candidate) for candidate in values["suspected"]]
        if self._log is not None and values["log_bytes"] is not None:
            self._log.truncate(values["log_bytes"])


def _found_motion(atlas: Atlas, found: Relocalisation) -> dict[str, Any]:
    """The pose of a relocalised frame, the newest submap's anchor, relative to a keyframe.

    That is the nearest one of the submap in which the frame was relocalised.
    """
    poses = atlas.keyframe_poses(found.submap)
    if not poses:
        return {}
    T_query = found.T_submap_camera
    match = min(poses, key=lambda index: np.linalg.norm(poses[index][:3, 3] - T_query[:3, 3]))
    query = next(iter(atlas.keyframe_poses(atlas.active)))
    motion = motion_values(se3.inverse(poses[match]) @ T_query)
    return {"query": query, "match": match} | motion
