"""A small room for the whole system, and comparisons of two systems."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.options import validated
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.factory import build_code
from toolkit.semantics.labeller import IgnoredPixels
from toolkit.semantics.options import SegmenterOptions, SemanticsOptions
from toolkit.semantics.taxonomy_building.factory import build_labeller
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping
from toolkit.slam.system import FrameResult, Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.placement import KeyframePlacement

FEW = MapperOptions(iterations=4, first_iterations=12, final_iterations=2)


@dataclass(frozen=True)
class SlamRoom:
    """Frames, and the true path in the first camera's frame."""

    frames: list[Frame]
    truth: Trajectory


def first_steps(count: int = 14) -> SlamRoom:
    frames, truth = tiny_room(count, 96, 72)
    return SlamRoom(frames, truth.transformed(se3.inverse(truth.T_world_camera[0])))


def another_place(frame: Frame) -> Frame:
    """The view upside down in a room of twice the size, in opposite colours."""
    rgb = np.ascontiguousarray(1.0 - frame.rgb[::-1, ::-1])
    return replace(frame, rgb=rgb, depth_m=2.0 * frame.depth_m[::-1, ::-1])


def new_slam(
    seed: int = 0, placed: bool = True, sources: FrameSources | None = None, **front_end: Any
) -> Slam:
    """With keyframes placed by earlier ones, or where they are tracked."""
    placement = KeyframePlacement() if placed else None
    return Slam(
        FrontEnd(DenseTracker(), placement=placement, **front_end),
        Mapper(FEW, np.random.default_rng(seed)),
        sources=sources,
    )


def new_semantic_slam(kind: str, seed: int = 0, others: IgnoredPixels | None = None) -> Slam:
    """With labels of the room's own ("recorded") or of its planes ("geometric")."""
    settings = validated(SemanticsOptions, {"network": {"use": True}, "loss": {"inter_from": 1}})
    source = validated(SegmenterOptions, {"kind": kind})
    labeller = build_labeller(settings, source, dict(enumerate(CLASS_NAMES, start=1)))
    assert labeller is not None
    labeller.others = others
    code = build_code(settings.code, labeller.taxonomy)
    semantics = build_semantic_mapping(settings, code, 0)
    mapper = Mapper(FEW, np.random.default_rng(seed), semantics=semantics)
    sources = FrameSources(labeller)
    return Slam(FrontEnd(DenseTracker(), placement=KeyframePlacement()), mapper, sources=sources)


def fed(slam: Slam, frames: Iterable[Frame], hold_out: int | None = None) -> list[FrameResult]:
    """What became of each frame; every n-th is kept out of the map."""
    return [
        slam.process_frame(f, may_map=not (hold_out and f.index % hold_out == hold_out - 1))
        for f in frames
    ]


def fingerprint(slam: Slam) -> dict[str, bytes]:
    """Everything that decides the outcome, as bytes."""
    arrays, values = slam.state()
    out = {name: array.tobytes() for name, array in arrays.items()}
    out["values"] = json.dumps(values, sort_keys=True).encode()
    result = slam.result()
    out["frames"] = repr((result.frame_indices, result.lost_frames)).encode()
    out["path"] = result.trajectory.T_world_camera.tobytes()
    return out


def blind_frames(frames: Iterable[Frame]) -> list[Frame]:
    """Frames of a covered lens."""
    return [replace(f, rgb=np.zeros_like(f.rgb), depth_m=np.zeros_like(f.depth_m)) for f in frames]
