"""Label consensus: features of the Gaussians and corrected labels from votes of all keyframes.

Optimisation on one keyframe after another would take many rounds to outvote a wrong label. Here
every keyframe votes once. Then each connected segment of a label image is compared with the map,
and takes the map's class if that is more probable. Segmenters usually mislabel entire segments.
Therefore the part of a segment that other views observe also decides on the rest of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.geometry.regions import connected_regions
from toolkit.keyframe import Keyframe
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import SurfaceView

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


def label_consensus(
    gaussians: GaussianCloud,
    keyframes: list[Keyframe],
    semantics: SemanticMapping,
    render: Render,
    rounds: int,
) -> GaussianCloud:
    """Return the Gaussians with the features that all labelled keyframes vote for.

    Corrects `class_ids` of keyframes in place.

    Args:
        render: renders Gaussians with their features from a camera at a pose.
        rounds: of correction and voting; 0 only votes.
    """
    labelled = [keyframe for keyframe in keyframes if keyframe.class_ids is not None]
    votes = _FeatureVotes(gaussians, semantics, render)
    for keyframe in labelled:
        votes.add(keyframe)
    for _ in range(rounds):
        gaussians = votes.fitted()
        changed = False
        for keyframe in labelled:
            view = _counted_view(gaussians, votes.views, keyframe, render)
            corrected = _corrected(view, keyframe, semantics)
            if corrected is not None:
                votes.change(keyframe, corrected, view)
                keyframe.class_ids = corrected
                changed = True
        if not changed:
            return gaussians
    return votes.fitted()


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


def _corrected(view: SurfaceView, keyframe: Keyframe, semantics: SemanticMapping) -> Tensor | None:
    """Labels of a keyframe with corrected segments; None if no segment changes.

    Args:
        view: see `_counted_view`.
    """
    silhouette = view.output.silhouette.clamp(min=0.5)
    known = (view.images[0] / silhouette >= _MIN_VIEWS).view(-1).cpu().numpy()
    class_ids, probabilities = semantics.probabilities(view)
    if not len(class_ids):
        return None  # every pixel so far is void
    assert keyframe.class_ids is not None
    segments, own_class = connected_segments(keyframe.class_ids.numpy())
    stride = _stride(keyframe.camera.width)
    flat = segments[::stride, ::stride].reshape(-1)
    count = len(own_class)
    area = np.bincount(flat, minlength=count)
    evidence = np.bincount(flat[known], minlength=count)
    means = np.stack(
        [np.bincount(flat[known], p[known], minlength=count) for p in probabilities.cpu().numpy()]
    ) / np.maximum(evidence, 1)
    row = np.minimum(np.searchsorted(class_ids, own_class), len(class_ids) - 1)
    own_probability = means[row, np.arange(count)]
    most_probable = means.argmax(axis=0)
    changed = evidence > np.maximum(_MIN_SHARE * area, 1.0)
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
