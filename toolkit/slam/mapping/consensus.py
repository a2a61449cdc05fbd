"""Label consensus: features of the Gaussians and corrected labels from votes of all keyframes.

Optimisation on one keyframe after another would take many rounds to outvote a wrong label. Here
every keyframe votes once. Then each connected segment of a label image is compared with the map,
and takes the map's class if that is more probable. Segmenters usually mislabel entire segments.
Therefore the part of a segment that other views observe also decides on the rest of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.regions import connected_regions
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import SurfaceView

Render = Callable[[GaussianCloud, Camera, NDArray[np.float64]], SurfaceView]

# Votes and comparisons use every n-th pixel in each direction, so that about this width remains. At
# a width of 320, half of the pixels in each direction take half the time or less, and mIoU changes
# by less than 0.1 points. With a larger stride, many Gaussians lie between the sampled pixels.
_SAMPLED_WIDTH, _MAX_STRIDE = 160, 3
# Gaussians with a smaller number of votes keep their features: those of frames between keyframes
# would lose their label where the border of a keyframe's image just touches them.
_MIN_VOTES = 0.05
# Minimum number of views of a pixel's Gaussians for the pixel to count as evidence, minimum
# fraction of a segment's pixels that are evidence, and minimum probability margin of the map's
# class over the segment's.
_MIN_VIEWS, _MIN_SHARE, _MARGIN = 1.5, 0.1, 0.1
# The same for a pixel whose label is compared with the map: its own view has one of the votes.
_COMPARED_VIEWS = 2.5
# Part of the pixels with another class than the map that is warned of. Right labels have less than
# 0.01, labels of which 20 or 30 % of the segments are wrong have 0.2 or 0.26, ids that are permuted
# in every frame 0.9.
_MANY_CHANGED = 0.4


@dataclass(frozen=True)
class LabelAgreement:
    """How many labelled pixels of keyframes have another class than the map.

    Attributes:
        compared: number of pixels of surfaces with the votes of several keyframes.
        changed: number of those whose label is not the class of most votes.
    """

    compared: int = 0
    changed: int = 0

    def __add__(self, other: LabelAgreement) -> LabelAgreement:
        return LabelAgreement(self.compared + other.compared, self.changed + other.changed)

    @property
    def changed_share(self) -> float | None:
        """The fraction of changed pixels, in [0, 1]; None without compared ones."""
        return self.changed / self.compared if self.compared else None

    @property
    def findings(self) -> tuple[str, ...]:
        """A line about labels that do not agree between keyframes, if they do not."""
        share = self.changed_share
        if share is None or share < _MANY_CHANGED:
            return ()
        return (
            f"The labels of keyframes disagree: their votes changed {share:.0%} of the labelled "
            f"pixels. Ids must keep their meaning in all frames; those of masks without tracking "
            f"do not (--instances.kind folder reads such masks).",
        )


@dataclass(frozen=True, eq=False)
class LabelConsensus:
    """Gaussians with the features that keyframes vote for, and how the labels agreed before."""

    gaussians: GaussianCloud
    agreement: LabelAgreement = LabelAgreement()


def label_consensus(
    gaussians: GaussianCloud,
    keyframes: list[Keyframe],
    semantics: SemanticMapping,
    render: Render,
    rounds: int,
) -> LabelConsensus:
    """Return the Gaussians with the features that all labelled keyframes vote for.

    Corrects `class_ids` of keyframes in place.

    Args:
        render: renders Gaussians with their features from a camera at a pose.
        rounds: of correction and voting; 0 only votes, and compares no labels.
    """
    labelled = [keyframe for keyframe in keyframes if keyframe.class_ids is not None]
    votes = _FeatureVotes(gaussians, semantics, render)
    for keyframe in labelled:
        votes.add(keyframe)
    agreement = LabelAgreement()
    for number in range(rounds):
        gaussians = votes.fitted()
        changed = False
        for keyframe in labelled:
            view = _counted_view(gaussians, votes.views, keyframe, render)
            evidence = _evidence(view, semantics)
            if number == 0:
                agreement += _agreement(evidence, keyframe)
            corrected = _corrected(evidence, keyframe)
            if corrected is not None:
                votes.change(keyframe, corrected, view)
                keyframe.class_ids = corrected
                changed = True
        if not changed:
            return LabelConsensus(gaussians, agreement)
    return LabelConsensus(votes.fitted(), agreement)


class _FeatureVotes:
    """Votes for the features of Gaussians; they are sums, so that votes can be changed later.

    Attributes:
        views: [N] number of votes for each Gaussian, at most one per view.
    """

    def __init__(
        self, gaussians: GaussianCloud, semantics: SemanticMapping, render: Render
    ) -> None:
        self._gaussians, self._semantics, self._render = gaussians, semantics, render
        self._votes = torch.zeros_like(gaussians.features)
        self.views = gaussians.features.new_zeros(len(gaussians))

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe's votes."""
        labels = _sampled_labels(keyframe)
        view = _sampled_view(self._gaussians, keyframe, self._render)
        ids, votes, total = self._votes_of(
            keyframe, view, self._semantics.codewords(labels), labels > 0
        )
        weight = _view_weight(total)
        self._votes.index_add_(0, ids, votes * weight[:, None])
        self.views.index_add_(0, ids, total * weight)

    def change(self, keyframe: Keyframe, corrected: Tensor, view: SurfaceView) -> None:
        """Replace a keyframe's votes by those of corrected labels; void pixels stay void.

        Args:
            view: any sampled view from the keyframe; votes do not depend on colours and features.
        """
        labels = _sampled_labels(keyframe)
        change = self._semantics.codewords(_sampled(corrected)) - self._semantics.codewords(labels)
        ids, votes, total = self._votes_of(keyframe, view, change, labels > 0)
        self._votes.index_add_(0, ids, votes * _view_weight(total)[:, None])

    def _votes_of(
        self, keyframe: Keyframe, view: SurfaceView, codewords: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As `SemanticMapping.votes`, with sums as large as those over all pixels of the image."""
        area = _stride(keyframe.camera.width) ** 2
        ids, votes, total = self._semantics.votes(view, codewords, valid)
        return ids, votes * area, total * area

    def fitted(self) -> GaussianCloud:
        """The Gaussians with features fitted to the votes."""
        labelled = self.views > _MIN_VOTES
        features = self._gaussians.features.clone()
        votes = self._votes[labelled].clamp(min=0.0)
        features[labelled] = self._semantics.from_votes(votes, self.views[labelled])
        return replace(self._gaussians, features=features)


def _view_weight(total: Tensor) -> Tensor:
    """Weight that limits the votes of a view to one, so that close views do not dominate."""
    return 1.0 / total.clamp(min=1.0)


def _counted_view(
    gaussians: GaussianCloud, views: Tensor, keyframe: Keyframe, render: Render
) -> SurfaceView:
    """Sampled view with features, and with numbers of views [N] in place of the colour."""
    counted = replace(gaussians, colours=views[:, None].expand(-1, 3).contiguous())
    return _sampled_view(counted, keyframe, render)


def _sampled_view(gaussians: GaussianCloud, keyframe: Keyframe, render: Render) -> SurfaceView:
    """Render the sampled pixels of a keyframe."""
    camera = keyframe.camera
    stride = _stride(camera.width)
    sampled = Camera(
        camera.fx / stride,
        camera.fy / stride,
        camera.cx / stride,
        camera.cy / stride,
        -(-camera.width // stride),
        -(-camera.height // stride),
    )
    return render(gaussians, sampled, keyframe.T_map_camera)


def _stride(width: int) -> int:
    """Distance between sampled pixels of an image of a width."""
    return min(max(1, width // _SAMPLED_WIDTH), _MAX_STRIDE)


def _sampled(image: Tensor) -> Tensor:
    """The sampled pixels of an image [H, W]."""
    stride = _stride(image.shape[1])
    return image[::stride, ::stride]


def _sampled_labels(keyframe: Keyframe) -> Tensor:
    assert keyframe.class_ids is not None
    return _sampled(keyframe.class_ids)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What the map says about the sampled pixels of a keyframe.

    Attributes:
        class_ids: [K] observed classes, ascending.
        probabilities: [K, P] of these at each pixel.
        views: [P] numbers of views of the pixels' Gaussians.
    """

    class_ids: NDArray[np.int64]
    probabilities: NDArray[np.float32]
    views: NDArray[np.float32]


def _evidence(view: SurfaceView, semantics: SemanticMapping) -> _Evidence:
    """Read a view; see `_counted_view`."""
    silhouette = view.output.silhouette.clamp(min=0.5)
    views = (view.images[0] / silhouette).view(-1).cpu().numpy()
    class_ids, probabilities = semantics.probabilities(view)
    return _Evidence(class_ids, probabilities.cpu().numpy(), views)


def _agreement(evidence: _Evidence, keyframe: Keyframe) -> LabelAgreement:
    """Compare the labels of a keyframe with the most probable classes of the map."""
    own = _sampled_labels(keyframe).numpy().reshape(-1)
    compared = (evidence.views >= _COMPARED_VIEWS) & (own > 0)
    if not compared.any():
        return LabelAgreement()
    voted = evidence.class_ids[evidence.probabilities[:, compared].argmax(axis=0)]
    return LabelAgreement(int(compared.sum()), int((voted != own[compared]).sum()))


def _corrected(evidence: _Evidence, keyframe: Keyframe) -> Tensor | None:
    """Labels of a keyframe with corrected segments; None if no segment changes."""
    class_ids = evidence.class_ids
    if not len(class_ids):
        return None  # every pixel so far is void
    known = evidence.views >= _MIN_VIEWS
    assert keyframe.class_ids is not None
    segments, own_class = connected_segments(keyframe.class_ids.numpy())
    stride = _stride(keyframe.camera.width)
    flat = segments[::stride, ::stride].reshape(-1)
    count = len(own_class)
    area = np.bincount(flat, minlength=count)
    support = np.bincount(flat[known], minlength=count)
    means = np.stack(
        [np.bincount(flat[known], p[known], minlength=count) for p in evidence.probabilities]
    ) / np.maximum(support, 1)
    row = np.minimum(np.searchsorted(class_ids, own_class), len(class_ids) - 1)
    own_probability = means[row, np.arange(count)]
    most_probable = means.argmax(axis=0)
    changed = support > np.maximum(_MIN_SHARE * area, 1.0)
    changed &= means[most_probable, np.arange(count)] > own_probability + _MARGIN
    changed &= own_class > 0
    if not changed.any():
        return None
    corrected = np.where(changed, class_ids[most_probable], own_class)
    return torch.from_numpy(corrected[segments].astype(np.int16))


def connected_segments(labels: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Connected segments of a label image: their numbers [H, W] and the class of each [K]."""
    regions, classes = connected_regions(labels.astype(np.int32) + 1)
    return regions - 1, classes.astype(np.int64) - 1
