"""Depth of a few keyframes of a film, as far as other keyframes confirm it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset
from toolkit.depth.depth_priors.multi_view import MultiViewDepth, SweptKeyframe
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.splatting.alignment.levels import intensity_of

# Keyframes of a long film. Few successive ones see a part of the room: in the HoloLens walk, 12
# along the film show the floor 1.63 m below, and four groups of three take a table for the floor.
_VIEWS = 12
# Plane sweeps for the depth of a keyframe whose neighbours are not used, too.
_SWEEPS_PER_VIEW = 7


def with_confirmed_depth(
    motion: CameraMotion, dataset: Dataset
) -> Iterator[tuple[SweptKeyframe, Frame]]:
    """Keyframes all along a motion, and their images with depth in its unit of length.

    Args:
        dataset: source of the images.
    """
    depth = MultiViewDepth(
        motion.camera, motion.views, lambda index: intensity_of(dataset[index].rgb).numpy()
    )
    for number in _chosen(len(motion.views)):
        view = motion.views[number]
        frame = dataset[view.frame]
        yield view, replace(frame, depth_m=depth.depth(number), camera=motion.camera)


def _chosen(count: int) -> list[int]:
    """Numbers of the keyframes: all, or as many as take the same time."""
    if count <= _VIEWS * _SWEEPS_PER_VIEW:
        return list(range(count))
    return [int(n) for n in np.linspace(0, count - 1, _VIEWS).round()]
