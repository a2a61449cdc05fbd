"""A sequence of colour images as the RGB-D sequence that SLAM processes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import Dataset
from toolkit.datasets.images_only import ImagesOnly
from toolkit.datasets.prefetch import prefetched
from toolkit.depth.depth_priors.completion import CompletedDepth, DepthCompletion
from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.depth.depth_priors.multi_view import EstimatedDepth, MultiViewDepth
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.depth_priors.provider import DepthProvider
from toolkit.depth.depth_priors.source import PriorSource
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.splatting.alignment.levels import intensity_of


@dataclass(frozen=True)
class _PartDepth:
    """Depth of the keyframes of one part of a motion."""

    measured: MultiViewDepth
    completion: DepthCompletion | None = None

    def completed(self, number: int) -> EstimatedDepth | CompletedDepth:
        """Depth of a keyframe, completed by its prior, or else on planes without texture."""
        if self.completion is not None:
            return self.completion.depth(number)
        return self.measured.completed(number)


class MonocularSequence:
    """A dataset whose keyframes have the depth that neighbouring keyframes agree with.

    Other frames have no depth. Planes without texture and depth priors, where there are any,
    complete the depth of keyframes, which is then marked as inferred. If priors are used alone
    (`correction`), only the first keyframe of each part has depth, which fixes its unit of length.
    Implements `Dataset`; its ground truth is the estimated motion.

    Args:
        dataset: the recording; its depth is ignored.
        motion: estimated from it.
        provider: source of depth priors, or None.
        options: how priors are used.

    Attributes:
        trajectories: those of the parts of the motion, whose relative poses are unknown; the first
            one is the ground truth.
        part_of_keyframe: number of the part of each frame with depth, by index.
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
        self._images = ImagesOnly(dataset, motion.camera)
        self._provider, self._options = provider, options or DepthPriorOptions()
        motions = (motion, *motion.others)
        self._parts = [self._depth_of(one) for one in motions]
        self._views = {
            view.frame: (part, number)
            for part, one in enumerate(motions)
            for number, view in enumerate(one.views)
        }
        self.trajectories = tuple(one.trajectory for one in motions)
        self.part_of_keyframe = {frame: part for frame, (part, _) in self._views.items()}

    def _depth_of(self, motion: CameraMotion) -> _PartDepth:
        depth = MultiViewDepth(motion.camera, motion.views, self._intensity)
        if self._provider is None or self._options.use != "complete":
            return _PartDepth(depth)
        frames = [view.frame for view in motion.views]
        images = self._images.__getitem__
        source = PriorSource(self._provider, images, frames, self._options.size, stride=1)
        completion = DepthCompletion(
            motion.camera,
            motion.views,
            depth.depth,
            lambda number: source.prior(frames[number]).image,
            self._options,
        )
        return _PartDepth(depth, completion)

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` with estimated depth, in the unit of the estimated motion."""
        frame = self._images[index]
        if index not in self._views or len(self._views) < 2:
            return frame
        part, number = self._views[index]
        if number > 0 and self._uses_priors_alone:
            return frame
        found = self._parts[part].completed(number)
        return replace(frame, depth_m=found.depth, inferred=found.inferred)

    def __iter__(self) -> Iterator[Frame]:
        return prefetched(self, range(len(self)))

    def correction(self) -> DepthCorrection | None:
        """Correction of priors that are used alone, None if they are not."""
        if self._provider is None or not self._uses_priors_alone:
            return None
        return prior_correction(self._images, self._provider, self._options, needs_reference=True)

    @property
    def _uses_priors_alone(self) -> bool:
        return self._provider is not None and self._options.use == "correct"

    def _intensity(self, index: int) -> NDArray[np.float32]:
        return intensity_of(self._images[index].rgb).numpy()


def prior_correction(
    images: ImagesOnly,
    provider: DepthProvider,
    options: DepthPriorOptions,
    needs_reference: bool,
) -> DepthCorrection:
    """Correction of the priors of all frames, which are predicted in sets (H-14).

    Args:
        needs_reference: as in `DepthCorrection`.
    """
    size, stride = options.size, options.stride
    source = PriorSource(provider, images.__getitem__, range(len(images)), size, stride)
    return DepthCorrection(source.prior, options.correction, needs_reference)
