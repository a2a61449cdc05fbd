"""A few small images of a recording, by which a run knows it again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.datasets.base import Dataset

_COUNT, _SIZE = 5, (8, 6)
# Maximum mean difference of colours in [0, 1]. Other sizes and compression change less.
_MAX_DIFFERENCE = 0.03


def recording_samples(dataset: Dataset, indices: Sequence[int]) -> list[dict[str, Any]]:
    """Return small images of some of the frames, as they are stored with a run.

    Args:
        dataset: frames of the run.
        indices: of frames that can be read, at least five of them for the full number of images.
    """
    places = np.unique(np.linspace(0, len(indices) - 1, _COUNT).astype(int)) if indices else ()
    return [
        {"index": indices[n], "rgb": np.rint(255 * _small(dataset, indices[n])).tolist()}
        for n in places
    ]


def is_same_recording(dataset: Dataset, samples: Sequence[dict[str, Any]]) -> bool:
    """Whether at least half of the stored images are those of the dataset's frames.

    Frames that cannot be read are left out.
    """
    differs = []
    for sample in samples:
        if sample["index"] >= len(dataset):
            differs.append(True)
            continue
        try:
            own = _small(dataset, sample["index"])
        except ToolkitError:
            continue
        stored = np.array(sample["rgb"], np.float64) / 255
        differs.append(float(np.abs(own - stored).mean()) > _MAX_DIFFERENCE)
    return 2 * sum(differs) <= len(differs)


def _small(dataset: Dataset, index: int) -> NDArray[np.float64]:
    """Return the colours [6, 8, 3] of a frame, in [0, 1]."""
    return cv2.resize(dataset[index].rgb, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
