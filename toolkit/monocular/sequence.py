"""A sequence of colour images as the RGB-D sequence that SLAM processes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.levels import intensity_of
from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.depth_priors.multi_view import MultiViewDepth
from toolkit.frame import Frame
from toolkit.geometry.trajectory import Trajectory
from toolkit.monocular.motion import CameraMotion


class MonocularSequence:
    """A dataset whose keyframes have the depth that neighbouring keyframes agree with, completed on
    planes without texture.

    Other frames have no depth. Implements `Dataset`; its ground truth is the estimated motion.

    Args:
        dataset: the recording; its depth is ignored.
        motion: estimated from it.
    """

    def __init__(self, dataset: Dataset, motion: CameraMotion) -> None:
        self.name, self.camera = dataset.name, motion.camera
        self.label_names = dataset.label_names
        self.ground_truth: Trajectory | None = motion.trajectory
        self._dataset = dataset
        self._views = {view.frame: number for number, view in enumerate(motion.views)}
        self._depth = MultiViewDepth(motion.camera, motion.views, self._intensity)

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` with estimated depth, in the unit of the estimated motion."""
        frame = self._dataset[index]
        number = self._views.get(index)
        if number is None or len(self._views) < 2:
            depth = np.zeros_like(frame.depth_m)
        else:
            depth = self._depth.completed(number).depth
        return replace(frame, depth_m=depth, camera=self.camera)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))

    def _intensity(self, index: int) -> NDArray[np.float32]:
        return intensity_of(self._dataset[index].rgb).numpy()
