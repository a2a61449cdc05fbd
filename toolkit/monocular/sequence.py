"""A sequence of colour images as the RGB-D sequence that SLAM processes."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.levels import intensity_of
from toolkit.datasets.base import Dataset
from toolkit.datasets.prefetch import prefetched
from toolkit.depth_priors.completion import DepthCompletion
from toolkit.depth_priors.correction import DepthCorrection
from toolkit.depth_priors.multi_view import MultiViewDepth
from toolkit.depth_priors.options import DepthPriorOptions
from toolkit.depth_priors.provider import DepthProvider
from toolkit.depth_priors.source import PriorSource
from toolkit.frame import Frame
from toolkit.geometry.trajectory import Trajectory
from toolkit.monocular.motion import CameraMotion


class MonocularSequence:
    """A dataset whose keyframes have the depth that neighbouring keyframes agree with.

    Other frames have no depth. Planes without texture and depth priors, where there are any,
    complete the depth of keyframes, which is then marked as inferred. If priors are used alone
    (`correction`), only the first keyframe has depth, which fixes the unit of length.
    Implements `Dataset`; its ground truth is the estimated motion.

    Args:
        dataset: the recording; its depth is ignored.
        motion: estimated from it.
        provider: source of depth priors, or None.
        options: how priors are used.
    """

    def __init__(
        self,
        dataset: Dataset,
        motion: CameraMotion,
        provider: DepthProvider | None = None,
        options: DepthPriorOptions | None = None,
    ) -> None:
        self.name, self.camera = dataset.name, motion.camera
        self.label_names = dataset.label_names
        self.ground_truth: Trajectory | None = motion.trajectory
        self._dataset = dataset
        # Frames are read by a thread of their own, and by the correction of priors.
        self._reading = threading.Lock()
        self._frames = [view.frame for view in motion.views]
        self._views = {frame: number for number, frame in enumerate(self._frames)}
        self._depth = MultiViewDepth(motion.camera, motion.views, self._intensity)
        self._provider, self._options = provider, options or DepthPriorOptions()
        self._completion: DepthCompletion | None = None
        if provider is not None and self._options.use == "complete":
            source = PriorSource(provider, self._frame, self._frames, self._options.size, stride=1)
            self._completion = DepthCompletion(
                motion.camera,
                motion.views,
                self._depth.depth,
                lambda number: source.prior(self._frames[number]).image,
                self._options,
            )

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` with estimated depth, in the unit of the estimated motion."""
        frame = self._frame(index)
        number = self._views.get(index)
        if number is None or len(self._views) < 2 or (number > 0 and self._uses_priors_alone):
            return frame
        if self._completion is not None:
            by_prior = self._completion.depth(number)
            return replace(frame, depth_m=by_prior.depth, inferred=by_prior.inferred)
        by_planes = self._depth.completed(number)
        return replace(frame, depth_m=by_planes.depth, inferred=by_planes.inferred)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))

    def correction(self) -> DepthCorrection | None:
        """Correction of priors that are used alone, None if they are not."""
        if self._provider is None or not self._uses_priors_alone:
            return None
        options = self._options
        source = PriorSource(
            self._provider, self._frame, range(len(self)), options.size, options.stride
        )
        return DepthCorrection(source.prior, options.correction, needs_reference=True)

    @property
    def _uses_priors_alone(self) -> bool:
        return self._provider is not None and self._options.use == "correct"

    def _frame(self, index: int) -> Frame:
        """Frame `index` with the estimated intrinsics and without depth."""
        with self._reading:
            frame = self._dataset[index]
        return replace(frame, depth_m=np.zeros_like(frame.depth_m), camera=self.camera)

    def _intensity(self, index: int) -> NDArray[np.float32]:
        with self._reading:
            return intensity_of(self._dataset[index].rgb).numpy()
