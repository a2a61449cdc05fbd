"""Collects the result of a run, or its state so far, from atlas, camera path and loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.camera_path import CameraPath
from toolkit.slam.loops.closing.interface import LoopClosing
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.refinement.parts import Part, T_part_world, by_size
from toolkit.slam.result import SlamResult, SubmapSummary, TrackedFrames, separate_parts
from toolkit.slam.submaps.atlas import Atlas
from toolkit.splatting.gaussians.scene import InMemoryScene


def parts_of(atlas: Atlas, path: CameraPath, closer: LoopClosing) -> list[Part]:
    """Parts of the map: numbers of submaps with known relative poses, the main part first."""
    doubtful = path.doubtful_frames
    reliable = [index not in doubtful for index in path.indices]
    return by_size(closer.parts(atlas), path.submaps, reliable, atlas.saved)


def poses_beside(
    atlas: Atlas, path: CameraPath, parts: Sequence[Part], number: int
) -> NDArray[np.float64]:
    """Poses [P, 4, 4] of the reliable frames in the same part of the map as a submap."""
    part = next(part for part in parts if number in part)
    inside = np.isin(path.submaps, part)
    inside &= ~np.isin(path.indices, list(path.doubtful_frames))
    return path.trajectory(atlas).T_world_camera[inside]


def collected(
    atlas: Atlas,
    path: CameraPath,
    closer: LoopClosing,
    maps: Sequence[FusedMap | None],
    semantics: SemanticMapping,
    taxonomy: Taxonomy | None,
) -> SlamResult:
    """The result in the unit of the system.

    Args:
        maps: of the parts of a finished run, None where no submap is readable; empty before.
    """
    parts = parts_of(atlas, path, closer)
    covariances, exposures = None, {}
    if maps:
        exposures = {n: e for one in maps if one is not None for n, e in one.exposures.items()}
        covariances = closer.covariances(atlas, path.measured_poses(atlas))
    T_part = {number: T_part_world(atlas, part) for part in parts for number in part}
    submaps = [
        SubmapSummary(
            number,
            T_part[number] @ atlas.T_world_submap(number),
            list(atlas.keyframe_poses(number)),
            readable=number not in atlas.unreadable,
            exposure=exposures.get(number, IDENTITY),
        )
        for number in range(len(atlas))
    ]
    own = submaps[atlas.saved :]
    frames = TrackedFrames(
        path.trajectory(atlas),
        path.indices,
        path.submaps,
        path.exposures(atlas, exposures),
        covariances,
    )
    doubtful = path.doubtful_frames
    by_part = [frames.of(part, T_part[part[0]], doubtful) for part in parts]
    main, fused = by_part[0], maps[0] if maps else None
    return SlamResult(
        trajectory=main.trajectory,
        frame_indices=main.indices,
        exposures=main.exposures,
        lost_frames=dict(path.lost_frames),
        keyframe_indices=sorted({i for submap in own for i in submap.keyframe_indices}),
        submaps=submaps,
        allocation=list(atlas.verdicts),
        loops=list(closer.loops),
        map=InMemoryScene(atlas.gaussians.to("cpu")) if fused is None else fused,
        semantics=semantics,
        taxonomy=taxonomy,
        covariances=main.covariances,
        dropped_frames=list(path.dropped_frames),
        doubtful_frames=doubtful,
        keyframe_steps=path.steps,
        frame_submaps=main.submaps,
        parts=parts,
        other_parts=separate_parts(parts, by_part, maps, path),
    )
