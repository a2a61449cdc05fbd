"""Pairs of submaps of RedKitchen with a known relative pose, for `registration.py`.

Submaps are mapped along the recording, each in an arbitrary coordinate frame; no frame of the
recording is in both submaps of a pair. Pairs are drawn by their overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.shared.recordings import source_of
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.factory import build_describer
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.tracking.depth_filter import denoised

Array = NDArray[np.float64]

STEP = 5  # frames from keyframe to keyframe
SPACING = 12  # frames from submap to submap; with STEP, neighbours share no frame
FEWEST, MOST = 5, 9  # keyframes of a submap
LEAST_OVERLAP = 0.3
FAR_M = 5.0  # how far a submap's frame may lie from its first camera
MOST_M, MOST_DEG = 0.5, 30.0  # of the offset of a start


@dataclass(frozen=True)
class Piece:
    """A submap and the true pose of its coordinate frame."""

    submap: Submap
    T_world_submap: Array
    frames: frozenset[int]


@dataclass(frozen=True)
class Pair:
    """Two submaps, the true motion, a start near it, and their overlap.

    Attributes:
        start: the truth after a motion of the source's first camera of up to MOST_M, MOST_DEG.
        overlap: share of the source's observed points that some target keyframe observed too.
    """

    target: Submap
    source: Submap
    T_target_source: Array
    start: Array
    overlap: float


def kitchen_pairs(count: int, seed: int) -> list[Pair]:
    """At most so many pairs of submaps of RedKitchen, which goes out and back."""
    generator = np.random.default_rng(seed)
    dataset = open_dataset(*source_of("redkitchen"))
    describer = build_describer(RunSettings().loops.features)
    pieces = []
    for first in range(0, len(dataset) - FEWEST * STEP, SPACING):
        last = first + STEP * int(generator.integers(FEWEST, MOST + 1))
        numbers = range(first, min(last, len(dataset)), STEP)
        pieces.append(piece(dataset, numbers, describer, generator))
    return draw_pairs(pieces, count, generator)


def piece(
    dataset: RecordedDataset,
    numbers: range,
    describer: ViewDescriber,
    generator: np.random.Generator,
) -> Piece:
    """Some frames mapped at their true poses, in an arbitrary coordinate frame."""
    assert dataset.ground_truth is not None
    T_world_camera = dataset.ground_truth.T_world_camera
    mapper = Mapper(RunSettings().mapping, generator)
    submap = mapper.first_submap()
    T_submap_world = anywhere(generator) @ se3.inverse(T_world_camera[numbers[0]])
    for i in numbers:
        frame = dataset[i]
        frame = replace(frame, depth_m=denoised(frame.depth_m))
        mapper.add_keyframe(submap, Keyframe.from_frame(frame, T_submap_world @ T_world_camera[i]))
    pictures = torch.stack([keyframe.rgb for keyframe in submap.keyframes]) / 255.0
    submap.descriptors = describer.describe(pictures).numpy()
    return Piece(submap, se3.inverse(T_submap_world), frozenset(numbers))


def anywhere(generator: np.random.Generator) -> Array:
    """A random rotation and a translation of up to several metres."""
    quaternion = generator.normal(size=4)
    unit = np.roll(quaternion, -1) / np.linalg.norm(quaternion)
    R = se3.rotation_from_quaternion_xyzw(unit)
    return se3.from_rotation_translation(R, generator.uniform(-FAR_M, FAR_M, size=3))


def draw_pairs(pieces: Sequence[Piece], count: int, generator: np.random.Generator) -> list[Pair]:
    """At most so many pairs, their overlaps as evenly spread over 30-100 % as the pieces have them.

    The submap with more keyframes is the target (G).
    """
    possible = []
    for pair in combinations(pieces, 2):
        if pair[0].frames & pair[1].frames:
            continue
        target, source = sorted(pair, key=lambda own: -len(own.frames))
        share = overlap(target, source)
        if share >= LEAST_OVERLAP:
            possible.append((share, target, source))
    pairs: list[Pair] = []
    while possible and len(pairs) < count:
        wanted = generator.uniform(LEAST_OVERLAP, 1.0)
        nearest = int(np.argmin([abs(share - wanted) for share, *_ in possible]))
        share, target, source = possible.pop(nearest)
        truth = se3.inverse(target.T_world_submap) @ source.T_world_submap
        camera = source.submap.keyframes[0].T_map_camera
        start = truth @ camera @ offset(generator) @ se3.inverse(camera)
        pairs.append(Pair(target.submap, source.submap, truth, start, share))
    return pairs


def overlap(target: Piece, source: Piece) -> float:
    """Share of the source's observed points that lie in some target keyframe's observed volume."""
    T_target_source = se3.inverse(target.T_world_submap) @ source.T_world_submap
    points = np.concatenate([keyframe.points_in_map() for keyframe in source.submap.keyframes])
    points = se3.transform_points(T_target_source, points)
    seen = [keyframe.reaches(points) for keyframe in target.submap.keyframes]
    return float(np.any(seen, axis=0).mean())


def offset(generator: np.random.Generator) -> Array:
    """A motion of up to MOST_M and MOST_DEG in a random direction."""
    direction = generator.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    metres, radians = generator.random(2) * [MOST_M, np.deg2rad(MOST_DEG)]
    return se3.exp(np.concatenate([metres * direction[0], radians * direction[1]]))
