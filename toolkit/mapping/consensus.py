"""What all keyframes together say a Gaussian is, and which of their labels were wrong.

Steps on one keyframe after another would take many rounds to vote a wrong label out. Here
every keyframe votes once; then each connected piece of a label image is held against the
map, and takes the map's class where that is the likelier: segmenters err by whole segments,
so a part of one that other views know tells about the part that only this view has seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.keyframe import Keyframe
from toolkit.mapping.options import ConsensusOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import SurfaceView

Draw = Callable[[GaussianCloud, Keyframe], SurfaceView]


def label_consensus(
    gaussians: GaussianCloud,
    keyframes: list[Keyframe],
    semantics: SemanticMapping,
    draw: Draw,
    options: ConsensusOptions,
) -> GaussianCloud:
    """Return the Gaussians with the features that all labelled keyframes vote for.

    Corrects `class_ids` of keyframes in place.

    Args:
        draw: the Gaussians as a keyframe sees them, with their features.
    """
    labelled = [keyframe for keyframe in keyframes if keyframe.class_ids is not None]
    ballot = _Ballot(gaussians, semantics, draw)
    for keyframe in labelled:
        ballot.count(keyframe)
    for _ in range(options.rounds):
        gaussians = ballot.elected()
        changed = False
        for keyframe in labelled:
            better = _corrected(gaussians, ballot.views, keyframe, semantics, draw, options)
            if better is not None:
                ballot.recount(keyframe, better)
                keyframe.class_ids = better
                changed = True
        if not changed:
            return gaussians
    return ballot.elected()


class _Ballot:
    """Votes for the features of Gaussians; counting is linear, so votes can be taken back.

    Attributes:
        views: [N] how many views told of each Gaussian.
    """

    def __init__(self, gaussians: GaussianCloud, semantics: SemanticMapping, draw: Draw) -> None:
        self._gaussians, self._semantics, self._draw = gaussians, semantics, draw
        self._votes = torch.zeros_like(gaussians.features)
        self.views = gaussians.features.new_zeros(len(gaussians))

    def count(self, keyframe: Keyframe) -> None:
        """Add a keyframe's votes."""
        labels = keyframe.labels
        assert labels is not None
        words = self._semantics.codewords(labels)
        ids, votes, share = self._semantics.votes(self._view(keyframe), words, labels > 0)
        weight = _one_vote(share)
        self._votes[ids] += votes * weight[:, None]
        self.views[ids] += share * weight

    def recount(self, keyframe: Keyframe, better: Tensor) -> None:
        """Change a counted keyframe's votes to those of better labels, void where it was void."""
        labels = keyframe.labels
        assert labels is not None
        change = self._semantics.codewords(better) - self._semantics.codewords(labels)
        ids, votes, share = self._semantics.votes(self._view(keyframe), change, labels > 0)
        self._votes[ids] += votes * _one_vote(share)[:, None]

    def _view(self, keyframe: Keyframe) -> SurfaceView:
        return self._draw(self._gaussians, keyframe)

    def elected(self) -> GaussianCloud:
        """The Gaussians with the features that the votes ask for."""
        told = self.views > 1e-6
        features = self._gaussians.features.clone()
        votes = self._votes[told].clamp(min=0.0)
        features[told] = self._semantics.from_votes(votes, self.views[told])
        return replace(self._gaussians, features=features)


def _one_vote(share: Tensor) -> Tensor:
    """One view, one vote: a close look shall not outvote two from afar."""
    return 1.0 / share.clamp(min=1.0)


def _corrected(
    gaussians: GaussianCloud,
    views: Tensor,
    keyframe: Keyframe,
    semantics: SemanticMapping,
    draw: Draw,
    options: ConsensusOptions,
) -> Tensor | None:
    """A keyframe's labels with the overruled segments renamed, or None if there are none."""
    # The number of views is drawn in the place of red.
    counted = replace(gaussians, colours=views[:, None].expand(-1, 3).contiguous())
    view = draw(counted, keyframe)
    silhouette = view.output.silhouette.clamp(min=0.5)
    known = (view.images[0] / silhouette >= options.min_views).view(-1).cpu().numpy()
    class_ids, probabilities = semantics.probabilities(view)
    assert keyframe.class_ids is not None
    labels = keyframe.class_ids.numpy()
    segments, own = segments_of(labels)
    flat = segments.reshape(-1)
    count = len(own)
    area = np.bincount(flat, minlength=count)
    evidence = np.bincount(flat[known], minlength=count)
    means = np.stack(
        [np.bincount(flat[known], p[known], minlength=count) for p in probabilities.cpu().numpy()]
    ) / np.maximum(evidence, 1)
    place = np.searchsorted(class_ids, own)
    said = means[np.minimum(place, len(class_ids) - 1), np.arange(count)]
    likeliest = means.argmax(axis=0)
    overruled = evidence > np.maximum(options.min_share * area, 1.0)
    overruled &= means[likeliest, np.arange(count)] > said + options.margin
    overruled &= own > 0
    if not overruled.any():
        return None
    better = np.where(overruled, class_ids[likeliest], own)
    return torch.from_numpy(better[segments].astype(np.int16))


def segments_of(labels: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Connected pieces of a label image: their numbers [H, W], and the class of each [K]."""
    segments = np.zeros(labels.shape, np.int32)
    classes: list[int] = []
    for class_id in np.unique(labels):
        found, pieces = cv2.connectedComponents((labels == class_id).astype(np.uint8))
        inside = pieces > 0
        segments[inside] = pieces[inside] - 1 + len(classes)
        classes += [int(class_id)] * (found - 1)
    return segments, np.array(classes, np.int64)
