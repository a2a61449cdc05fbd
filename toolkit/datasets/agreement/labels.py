"""Whether labels of the same surface agree between frames.

Ids of masks that were made in each frame alone are permuted from frame to frame: an assignment of
the ids of one frame to those of another explains the disagreement, which it does not if a
segmenter confuses classes.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from toolkit.datasets.agreement.pairs import FramePair, Labels, samples_in_second

# Maximum distance between the samples of a frame and the surface of another one, relative.
_MAX_DISTANCE = 0.03
_MIN_COMPARED = 500
# Shares of samples whose labels disagree. Right labels have up to 0.02, labels of which 20 % of the
# segments are wrong have up to 0.55.
_NOTED, _MANY = 0.05, 0.6
# Permuted ids leave less than this part of the disagreement after the best assignment of ids; wrong
# segments leave 0.04 to 0.5.
_UNEXPLAINED = 0.035


def label_finding(pairs: Sequence[FramePair]) -> str | None:
    """A line about labels whose ids change their meaning between frames; None if they do not.

    Args:
        pairs: frames and their motion by images; those without labels are left out.
    """
    compared = differing = unexplained = 0
    for pair in pairs:
        counts = _confusion(pair)
        compared += int(counts.sum())
        differing += int(counts.sum() - np.trace(counts))
        unexplained += int(counts.sum() - counts[linear_sum_assignment(-counts)].sum())
    if compared < _MIN_COMPARED:
        return None
    share = differing / compared
    permuted = share > _NOTED and unexplained < _UNEXPLAINED * differing
    return disagreement(share) if permuted or share > _MANY else None


def disagreement(share: float) -> str:
    """The line about labels of which a share in [0, 1] disagrees."""
    return (
        f"labels of the same surface disagree between frames ({share:.0%} of the compared pixels), "
        f"as ids of masks without tracking do; use one id for each class in all frames, or add the "
        f"images as masks: --instances.kind folder --instances.path FOLDER"
    )


def _confusion(pair: FramePair) -> NDArray[np.int64]:
    """Numbers of samples [K, K] by their label in the first and the second frame."""
    if pair.labels is None:
        return np.zeros((0, 0), np.int64)
    first, second = pair.levels
    own = samples_in_second(first, first, np.eye(4), _MAX_DISTANCE)
    other = samples_in_second(first, second, pair.pose.T_second_first, _MAX_DISTANCE)
    inner = [_inner(labels) for labels in pair.labels]
    ids = np.stack([inner[0][own.rows, own.columns], inner[1][other.rows, other.columns]])
    known, places = np.unique(ids[:, other.seen & (ids > 0).all(axis=0)], return_inverse=True)
    rows, columns = places.reshape(2, -1)
    counts = np.zeros((len(known), len(known)), np.int64)
    np.add.at(counts, (rows, columns), 1)
    return counts


def _inner(labels: Labels) -> NDArray[np.float32]:
    """Labels that all neighbours of a pixel share; 0 elsewhere."""
    image, window = labels.astype(np.float32), np.ones((3, 3), np.uint8)
    same = cv2.erode(image, window) == cv2.dilate(image, window)
    return np.where(same, image, np.float32(0.0))
