"""Masks that may overlap, as one image of ids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toolkit.scene.instances.masks import InstanceMasks


def layered(
    masks: Sequence[NDArray[np.bool_]],
    scores: Sequence[float],
    classes: Sequence[str | None],
    shape: tuple[int, int],
) -> InstanceMasks:
    """Put small masks in front of large ones; those that are hidden are left out.

    Args:
        masks: K masks [H, W].
        scores: [K] confidences.
        classes: [K] class names.
        shape: height and width.
    """
    ids = np.zeros(shape, np.int32)
    for k in sorted(range(len(masks)), key=lambda k: -int(masks[k].sum())):
        ids[masks[k]] = k + 1
    shown, rows = np.unique(np.append(0, ids), return_inverse=True)
    kept = shown[1:] - 1
    confidences = np.clip(np.asarray(scores, np.float32), 0.0, 1.0)[kept]
    return InstanceMasks(
        rows[1:].reshape(shape).astype(np.int32),
        [classes[k] for k in kept],
        confidences,
        np.zeros((len(kept), 0), np.float32),
    )
