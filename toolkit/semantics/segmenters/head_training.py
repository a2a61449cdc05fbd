"""Train a linear head on the features of labelled frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.semantics.segmenters.linear_head import Encoder, HeadSegmenter, LinearHead
from toolkit.semantics.segmenters.vocabulary import ClassVocabulary


@dataclass(frozen=True)
class HeadTrainingOptions:
    """Options of the training of a head.

    Attributes:
        patches_per_frame: maximum number of random patches per frame.
        steps: maximum number of L-BFGS iterations.
        decay: weight of the L2 regularisation.
    """

    patches_per_frame: int = 2000
    steps: int = 100
    decay: float = 1e-4


@dataclass(frozen=True)
class HeadScore:
    """Scores of a head on held-out frames, without void pixels.

    Attributes:
        frames: number of frames.
        accuracy: fraction of correctly classified pixels.
        mean_iou: mean IoU of the classes in the labels of these frames.
    """

    frames: int
    accuracy: float
    mean_iou: float


def train_head(
    encoder: Encoder,
    frames: Iterable[Frame],
    names: Mapping[int, str],
    generator: np.random.Generator,
    options: HeadTrainingOptions | None = None,
) -> LinearHead:
    """Fit a head by multinomial regression to the fractions of the classes in each patch.

    Args:
        encoder: computes the patch features.
        frames: labelled frames; frames without labels are skipped.
        names: class names by label id; the head predicts the classes that appear in the labels.
        generator: selects the patches.
        options: training options.

    Raises:
        DatasetError: no pixel has a class, an id has no name, or several ids have the same name.
    """
    options = options or HeadTrainingOptions()
    vocabulary = ClassVocabulary(names, "the dataset's classes.json")
    repeated = sorted({n for n in names.values() if list(names.values()).count(n) > 1})
    if repeated:
        raise DatasetError(f"several classes of the dataset have the name '{repeated[0]}'")
    ids = np.array(sorted(names))
    features, targets = [], []
    for frame in frames:
        if frame.labels is None:
            continue
        vocabulary.check(frame.labels, f"the label image of frame {frame.index}")
        found = encoder.features(frame).cpu()
        fractions = _patch_labels(frame.labels, ids, found.shape[:2])
        found, fractions = found.flatten(0, 1), fractions.reshape(-1, len(ids))
        labelled = np.flatnonzero(fractions.sum(axis=1) > 0)
        chosen = generator.permutation(labelled)[: options.patches_per_frame]
        features.append(found[torch.from_numpy(chosen)])
        targets.append(torch.from_numpy(fractions[chosen]))
    if not features or not sum(len(t) for t in targets):
        raise DatasetError("no frame has a labelled pixel; training a head needs labels")
    all_targets = torch.cat(targets)
    present = all_targets.sum(dim=0) > 0
    weights, bias = _fit(torch.cat(features), all_targets[:, present], options)
    kept = tuple(names[int(i)] for i in ids[present.numpy()])
    return LinearHead(weights, bias, kept, encoder.digest, encoder.longest_side)


def score_head(
    encoder: Encoder, head: LinearHead, frames: Iterable[Frame], names: Mapping[int, str]
) -> HeadScore:
    """Compare a head's labels with those of held-out frames.

    Raises:
        DatasetError: no frame has a labelled pixel.
    """
    segmenter = HeadSegmenter(encoder, head)
    count = max(names) + 1
    number = {name: i for i, name in names.items()}
    to_label = np.array([0, *(number[name] for name in head.class_names)])
    confusion, scored = np.zeros((count, count), np.int64), 0
    for frame in frames:
        if frame.labels is None:
            continue
        found = to_label[segmenter.segment(frame)]
        known = frame.labels > 0
        pairs = count * frame.labels[known].astype(np.int64) + found[known]
        confusion += np.bincount(pairs, minlength=count * count).reshape(count, count)
        scored += 1
    if not confusion.any():
        raise DatasetError("no held-out frame has a labelled pixel; scoring a head needs labels")
    right = np.diag(confusion)
    union = confusion.sum(axis=0) + confusion.sum(axis=1) - right
    present = confusion.sum(axis=1) > 0
    iou = right[present] / union[present]
    return HeadScore(scored, float(right.sum() / confusion.sum()), float(iou.mean()))


def _patch_labels(
    labels: NDArray[np.int32], ids: NDArray[np.int64], grid: tuple[int, ...]
) -> NDArray[np.float32]:
    """Return the fraction [rows, columns, C] of each class in each patch; void is left out."""
    rows, columns = grid
    fractions = [
        cv2.resize((labels == i).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        for i in ids
    ]
    return np.stack(fractions, axis=-1)


def _fit(
    features: torch.Tensor, targets: torch.Tensor, options: HeadTrainingOptions
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the weights [C, D] and bias [C] that minimise the regularised cross-entropy."""
    mean, deviation = features.mean(dim=0), features.std(dim=0, correction=0).clamp_min(1e-6)
    scaled = (features - mean) / deviation
    weights = scaled.new_zeros(targets.shape[1], features.shape[1], requires_grad=True)
    bias = scaled.new_zeros(targets.shape[1], requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [weights, bias], max_iter=options.steps, line_search_fn="strong_wolfe"
    )

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        likelihood = (scaled @ weights.T + bias).log_softmax(dim=1)
        value = -(targets * likelihood).sum() / targets.sum()
        value = value + options.decay * weights.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    with torch.no_grad():
        # Include the normalisation of the features in the weights and bias.
        unscaled = weights / deviation
        return unscaled.contiguous(), bias - unscaled @ mean
