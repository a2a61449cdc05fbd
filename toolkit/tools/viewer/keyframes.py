"""Keyframes of finished runs, and what they measured."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.io.images import small_image
from toolkit.runs.maps.finished import FinishedRun
from toolkit.slam.submaps.submap import Submap
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.scene import ShownKeyframe, ShownSplats

_log = logging.getLogger(__name__)

# Maximum difference of the depths of a Gaussian and of the pixel that observes it, as a fraction.
_ON_SURFACE = 0.05


@dataclass(frozen=True)
class SceneKeyframes:
    """Keyframes, and the Gaussians with the source of their positions.

    Attributes:
        keyframes: all keyframes of the readable submaps; some with images.
        splats: the Gaussians; `inferred` is set if the run used depth priors.
    """

    keyframes: tuple[ShownKeyframe, ...]
    splats: ShownSplats


def shown_keyframes(run: FinishedRun, splats: ShownSplats, content: ShownContent) -> SceneKeyframes:
    """Read the keyframes of a run from its submaps, one submap at a time.

    Without readable submaps, the keyframes have no images.
    """
    poses = {frame.index: frame.T_map_camera for frame in run.tracked}
    wanted = set(spread(run.keyframes, content.images))
    found: list[ShownKeyframe] = []
    evidence = DepthEvidence(splats)
    with_priors = run.settings.depth_prior.kind != "none"
    for submap in _submaps(run):
        for keyframe in submap.keyframes:
            T_map_camera = poses.get(keyframe.index)
            if T_map_camera is None:
                T_map_camera = submap.T_world_camera(keyframe)
            image = None
            if keyframe.index in wanted:
                image = small_image(keyframe.rgb.numpy(), content.image_width)
            found.append(ShownKeyframe(keyframe.index, T_map_camera, submap.number, image))
            if with_priors:
                evidence.add(keyframe, T_map_camera, submap.number)
    if not found:
        found = [ShownKeyframe(i, poses[i]) for i in run.keyframes if i in poses]
    found.sort(key=lambda keyframe: keyframe.index)
    return SceneKeyframes(tuple(found), replace(splats, inferred=evidence.inferred()))


def spread(numbers: list[int], count: int) -> list[int]:
    """Return at most `count` evenly spaced numbers of a list."""
    if len(numbers) <= count:
        return numbers
    places = np.linspace(0, len(numbers) - 1, count).round().astype(int)
    return [numbers[i] for i in places]


def _submaps(run: FinishedRun) -> Iterator[Submap]:
    """Yield the submaps of a run as far as they can be read."""
    try:
        saved = run.submaps
    except ToolkitError as error:
        _log.warning("Keyframes are shown without images: %s", error)
        return
    for number in saved:
        try:
            submap = saved[number]
        except ToolkitError as error:
            _log.warning("The keyframes of submap %d are not shown: %s", number, error)
            continue
        yield submap


class DepthEvidence:
    """Collects which Gaussians a sensor measured, and which follow from depth priors only.

    Args:
        splats: the Gaussians.
    """

    def __init__(self, splats: ShownSplats) -> None:
        self._splats = splats
        self._measured = np.zeros(len(splats), bool)
        self._inferred = np.zeros(len(splats), bool)

    def add(self, keyframe: Keyframe, T_map_camera: NDArray[np.float64], submap: int) -> None:
        """Add the Gaussians of a submap that a keyframe observes."""
        T_camera_map = se3.inverse(T_map_camera)
        points_m = self._splats.means_m @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
        near = points_m[:, 2] > 0.0
        if self._splats.submap is not None:
            near &= self._splats.submap == submap
        index = np.flatnonzero(near)
        pixels = np.rint(keyframe.camera.project(points_m[index])).astype(np.int64)
        inside = ((pixels >= 0) & (pixels < keyframe.camera.size)).all(axis=1)
        index, (x, y) = index[inside], pixels[inside].T
        depth_m = keyframe.depth_m.numpy()[y, x]
        seen = np.abs(points_m[index, 2] - depth_m) <= _ON_SURFACE * depth_m
        index, x, y = index[seen], x[seen], y[seen]
        inferred = np.full(len(index), keyframe.prior_m is not None)
        if keyframe.inferred is not None:
            inferred |= keyframe.inferred.numpy()[y, x]
        self._measured[index[~inferred]] = True
        self._inferred[index[inferred]] = True

    def inferred(self) -> NDArray[np.bool_] | None:
        """Return the mask of the inferred Gaussians, None if there are none."""
        mask = self._inferred & ~self._measured
        return mask if mask.any() else None
