"""Corrects depth priors with the depth of the map at the current pose (H-15, H-16)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.alignment import (
    REFERENCE_NOISE,
    Correction,
    Samples,
    ScaleShift,
    fit,
    fit_grid,
    samples_of,
)
from toolkit.depth.depth_priors.options import ScaleCorrectionOptions
from toolkit.depth.depth_priors.outliers import without_outliers
from toolkit.depth.depth_priors.provider import DepthKind, Image, PriorImage
from toolkit.depth.depth_priors.source import FramePrior
from toolkit.splatting.rendering import SurfaceView

# Of each image, at most this number of pixels is kept for the other images of its set.
_KEPT = 20_000
# The last sets that may still grow: as many as interleave.
_GROUPS = 16
# A grid with a smaller RMS deviation from the whole image only repeats the errors of the map.
_MIN_BEND = 0.03
# Depths that differ by at most this number of standard deviations belong to the same surface.
_SAME_SURFACE = 3.0
# Median depths of rooms, and a typical one.
_ROOMS, _TYPICAL = (0.5, 8.0), 2.0
_FIELDS = ("values", "reference", "weights", "positions")


@dataclass(frozen=True)
class RenderedDepth:
    """The map at the pose of a frame (H-15).

    Attributes:
        depth_m: [H, W] float32, 0 where the map shows no surface.
        silhouette: [H, W] float32.
    """

    depth_m: Image
    silhouette: Image

    @classmethod
    def of(cls, view: SurfaceView) -> RenderedDepth:
        """The images of a rendered view, on the CPU."""
        return cls(view.depth_m.cpu().numpy(), view.output.silhouette.cpu().numpy())


class DepthCorrection:
    """Gives frames the depth of their priors, in the unit of the map.

    Scale and shift of a group of frames are estimated from all of its frames so far. The first
    group fixes the unit of length: its prior is aligned with the depth that the first frame has,
    or stays as it is, except that a prior of unknown scale is given the size of a room.

    Args:
        prior: returns the prior of a frame index.
        options: of the alignment.
        needs_reference: the map cannot start at a frame without depth, because the poses have
            another unit of length than the prior.

    Attributes:
        found: last correction of each group.
        metric: whether the unit of length is the metre, by a metric prior of the first frame.
    """

    def __init__(
        self,
        prior: Callable[[int], FramePrior],
        options: ScaleCorrectionOptions,
        needs_reference: bool,
    ) -> None:
        self._prior, self._options, self._needs_reference = prior, options, needs_reference
        self._samples: OrderedDict[int, Samples] = OrderedDict()
        self._first: int | None = None
        self.found: dict[int, ScaleShift] = {}
        self.metric = False

    def start(self, frame: Frame) -> Frame:
        """The frame that starts the map, with the depth of its prior.

        Its own depth, where it has any, fixes the unit of length.
        """
        prior = self._filtered(frame.index)
        has_depth = bool((frame.depth_m > 0).any())
        if self._needs_reference and not has_depth:
            return frame
        group = self._group(frame, prior)
        samples = samples_of(prior.image, frame.depth_m)
        whole = self._fit(samples, prior.image.kind) if has_depth else _of_room_size(prior.image)
        if whole is None:
            return frame
        self.metric = prior.image.kind is DepthKind.METRIC and not has_depth
        self._first, self.found[group] = group, whole
        correction = self._local(samples, whole, prior.image) if has_depth else whole
        return self._corrected(frame, prior.image, correction)

    def correct(self, frame: Frame, rendered: RenderedDepth, final: bool = True) -> Frame:
        """A frame with the depth of its prior, aligned with the map where the map is opaque.

        Args:
            final: False at a predicted pose, before the frame is tracked. Later frames of the
                group do not learn from it, and only scale and shift of the whole image are
                aligned: what follows the map more closely would hold the frame at that pose.
        """
        prior = self._filtered(frame.index)
        group = self._group(frame, prior)
        visible = rendered.silhouette > self._options.min_silhouette
        reference = np.where(visible, rendered.depth_m, np.float32(0.0))
        own = samples_of(prior.image, reference)
        whole = self._whole(group, own, prior.image.kind, final)
        if whole is None:
            return frame
        if not final:
            return self._corrected(frame, prior.image, whole)
        found = self._corrected(frame, prior.image, self._local(own, whole, prior.image))
        if not self._options.filter:
            return found
        return replace(found, depth_m=_combined(found.depth_m, reference, whole.noise))

    def _filtered(self, index: int) -> FramePrior:
        prior = self._prior(index)
        if not self._options.filter:
            return prior
        return replace(prior, image=without_outliers(prior.image))

    def _group(self, frame: Frame, prior: FramePrior) -> int:
        return frame.index if self._options.share == "frame" else prior.group

    def _whole(self, group: int, own: Samples, kind: DepthKind, final: bool) -> ScaleShift | None:
        """Correction of a group with a new image; that of the last group if there is none."""
        if group == self._first or (not final and group in self.found):
            return self.found[group]
        kept = [self._samples[group]] if group in self._samples else []
        samples = Samples.joined([*kept, own.thinned(_KEPT)])
        whole = self._fit(samples, kind)
        if final:
            self._samples[group] = samples
            self._samples.move_to_end(group)
            while len(self._samples) > _GROUPS:
                self._samples.popitem(last=False)
        if whole is not None:
            if final:
                self.found[group] = whole
        elif self.found:
            whole = self.found.get(group, self.found[next(reversed(self.found))])
        return whole

    def _fit(self, samples: Samples, kind: DepthKind) -> ScaleShift | None:
        return fit(samples, kind, self._options.robust)

    def _local(self, samples: Samples, whole: ScaleShift, prior: PriorImage) -> Correction:
        nodes = self._options.grid
        if nodes < 2:
            return whole
        grid = fit_grid(samples, whole, nodes, with_shift=False)
        return whole if grid.bend < _MIN_BEND else grid

    @staticmethod
    def _corrected(frame: Frame, prior: PriorImage, correction: Correction) -> Frame:
        return replace(frame, depth_m=correction.apply(prior))

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {
            f"{group}/{name}": getattr(samples, name)
            for group, samples in self._samples.items()
            for name in _FIELDS
        }
        found = {str(group): list(vars(f).values()) for group, f in self.found.items()}
        return arrays, {
            "groups": list(self._samples),
            "first": self._first,
            "found": found,
            "metric": self.metric,
        }

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._samples = OrderedDict(
            (group, Samples(*(np.array(arrays[f"{group}/{name}"]) for name in _FIELDS)))
            for group in values["groups"]
        )
        self._first, self.metric = values["first"], values["metric"]
        self.found = {int(group): ScaleShift(*f) for group, f in values["found"].items()}


def _of_room_size(prior: PriorImage) -> ScaleShift:
    """The correction of a prior that fixes the unit of length.

    A system works in metres, at the size of rooms. Where the scale of a prior is unknown and its
    depth is far from that, its median becomes a typical one.
    """
    as_it_is = ScaleShift(1.0)
    depth = as_it_is.apply(prior)
    if prior.kind is DepthKind.METRIC or not depth.any():
        return as_it_is
    median = float(np.median(depth[depth > 0]))
    if _ROOMS[0] <= median <= _ROOMS[1]:
        return as_it_is
    return ScaleShift(median / _TYPICAL if prior.kind.inverse else _TYPICAL / median)


def _combined(depth_m: Image, reference_m: Image, noise: float) -> Image:
    """Mean of corrected and rendered depth [H, W] where both show the same surface.

    Weights follow from their errors. Without it, every noisy prior would scatter the surface that
    the map knows already, and scattered surfaces are rendered too near.

    Args:
        noise: standard deviation of the difference, relative to the depth.
    """
    difference = depth_m - reference_m
    same = (depth_m > 0) & (reference_m > 0)
    same &= np.abs(difference) < _SAME_SURFACE * noise * reference_m
    share = min((REFERENCE_NOISE / max(noise, REFERENCE_NOISE)) ** 2, 1.0)
    return np.where(same, reference_m + np.float32(share) * difference, depth_m)
