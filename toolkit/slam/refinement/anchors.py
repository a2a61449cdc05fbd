"""Stage 2 of global refinement: align the submaps in the joint map (G, end of III.C).

The paper minimises the difference between a submap rendered in its own frame and in that of the
world. Rendered alone, both images are the same for any anchor. Here the world contains the
overlapping submaps as well, and the image is compared with the keyframe that the submap was
optimised on in stage 1. Gaussians are constant, and the first anchor of each part is fixed.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.slam.loops.closing.visibility import Visibility
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.pose_adam import PoseAdam
from toolkit.splatting.gaussians.cloud import GaussianCloud

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# G: number of iterations on each keyframe.
_ITERATIONS = 10
# Adam's learning rates, which the paper does not print: those of keyframe poses, times five.
_TRANSLATION_RATE_M, _ROTATION_RATE_RAD = 5e-4, 2.5e-4
# Minimum overlap of the views of two submaps that are rendered together.
_MIN_OVERLAP = 0.1
# Number of submaps in memory.
_SUBMAPS = 16


def align_anchors(atlas: Atlas, mapper: Mapper, parts: Sequence[Sequence[int]]) -> None:
    """Optimise the anchors of the overlapping submaps of each part; those of a loaded map stay.

    Args:
        mapper: of the submaps, with the loss of the final refinement.
        parts: numbers of submaps with known relative poses.
    """
    readable = set(atlas.readable())
    for part in parts:
        numbers = [number for number in part if number in readable]
        if len(numbers) > 1:
            _AnchorAlignment(atlas, mapper, numbers).run()


class _AnchorAlignment:
    """Gradient descent on the anchors of one part."""

    def __init__(self, atlas: Atlas, mapper: Mapper, numbers: list[int]) -> None:
        self._atlas, self._mapper = atlas, mapper
        fixed = {numbers[0], *range(atlas.saved)}
        self._anchors = {number: atlas.T_world_submap(number) for number in numbers}
        self._adam = {
            number: PoseAdam(_TRANSLATION_RATE_M, _ROTATION_RATE_RAD)
            for number in numbers
            if number not in fixed
        }
        self._submaps: LruCache[Submap] = LruCache(_SUBMAPS)
        views = {number: Visibility.of(self._submap(number)) for number in numbers}
        self._overlapping = {
            a: [b for b in numbers if b != a and views[a].overlap(views[b]) >= _MIN_OVERLAP]
            for a in numbers
        }

    def run(self) -> None:
        """Optimise the anchors and store them in the atlas."""
        losses = [self._round(done) for done in range(_ITERATIONS)]
        if not losses[0]:
            return
        moved_m = 0.0
        for number in self._adam:
            before, after = self._atlas.T_world_submap(number), self._anchors[number]
            moved_m = max(moved_m, float(np.linalg.norm(after[:3, 3] - before[:3, 3])))
            self._atlas.move(number, after)
        _log.info(
            "Aligned %d submaps in the joint map: mean loss %.4f before, %.4f after; anchors moved "
            "by up to %.1f cm.",
            len(self._anchors),
            np.mean(losses[0]),
            np.mean(losses[-1]),
            100 * moved_m,
        )

    def _round(self, done: int) -> list[float]:
        """One step on each keyframe with an overlapping submap; returns the losses before them."""
        losses = []
        for number, others in self._overlapping.items():
            submap = self._submap(number)
            count = len(submap.keyframes) if others else 0
            for position in range(count):
                progress = (done * count + position, _ITERATIONS * count)
                losses.append(self._step(submap, position, others, progress))
        return losses

    def _step(
        self, submap: Submap, position: int, others: Sequence[int], progress: tuple[int, int]
    ) -> float:
        """One step on one keyframe, by all anchors that it depends on."""
        T_submap_other = {
            other: se3.inverse(self._anchors[submap.number]) @ self._anchors[other]
            for other in others
        }
        clouds = [submap.gaussians]
        for other, T in T_submap_other.items():
            clouds.append(self._submap(other).gaussians.transformed(T))
        joint = GaussianCloud.concatenate(clouds)
        loss, gradients = self._mapper.gradients(joint, submap.keyframes[position], progress)
        ids, means = gradients.ids.cpu().numpy(), gradients.means.cpu().double().numpy()
        points = joint.means.cpu().double().numpy()[ids]
        by_anchor: dict[int, Array] = {submap.number: np.zeros(6)}
        start = len(submap.gaussians)
        for (other, T), cloud in zip(T_submap_other.items(), clouds[1:], strict=True):
            mine = (ids >= start) & (ids < start + len(cloud))
            start += len(cloud)
            left = motion_gradient(points[mine], means[mine])
            # T_other exp(y) moves the points by exp(Ad(T) y), T_submap exp(x) by exp(-x).
            by_anchor[other] = se3.adjoint(T).T @ left
            by_anchor[submap.number] -= left
        self._descend(by_anchor)
        return loss

    def _descend(self, by_anchor: Mapping[int, Array]) -> None:
        for number, gradient in by_anchor.items():
            if number in self._adam and gradient.any():
                step = self._adam[number].step(gradient)
                self._anchors[number] = se3.orthonormalise(self._anchors[number] @ se3.exp(step))

    def _submap(self, number: int) -> Submap:
        device = self._mapper.device
        return self._submaps.get(number, lambda: self._atlas.submap(number).to(device))


def motion_gradient(points: Array, by_points: Array) -> Array:
    """Derivative [6] with respect to x in exp(x) applied to points [N, 3].

    Args:
        by_points: [N, 3] derivative with respect to the points.
    """
    return np.concatenate([by_points.sum(axis=0), np.cross(points, by_points).sum(axis=0)])
