"""The carrier of the camera in its images: the body of a robot, a hand, or the frame of a window.

Its pixels keep their depth and colour while the camera moves. As surfaces, they contradict every
motion of the camera: poses are pulled towards standing still, and the carrier is mapped again at
each keyframe.

Frames from the whole recording are compared in pairs. A pair counts if the rest of the image
differs: images of a camera that stands still show nothing. A blank floor or wall at a constant
distance keeps depth and colour as well, but it continues beyond its border. The carrier is in
front of its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.samples import spread_frames

Mask = NDArray[np.bool_]

# Frames are compared in cells, about so many in a row.
_CELLS = 80
# Maximum difference of the depth of a cell, relative, and of each of its colours.
_SAME_DEPTH, _SAME_COLOUR = 0.04, 0.1
# Minimum share of the cells that differ in a pair that may count, and of those that are not
# constant, in a pair that counts. In recordings of moving cameras, nearly all pairs have 0.97.
_MOTION, _CLEAR_MOTION = 1 / 3, 0.8
_MIN_PAIRS = 10
# Minimum share of the pairs in which a constant cell is measured, and in which it is the same then.
_MEASURED, _CONSTANT = 0.25, 0.8
# Minimum share of the image of a region, and of its surroundings that lie behind it. They are
# compared this many cells beyond its border, with the plane through two cells inside of it.
_MIN_AREA, _MOST = 0.005, 0.6
_INSIDE, _BEYOND = 2, 3
# Minimum ratio of depths at a border between two surfaces.
_STEP = 1.1
# The carrier is enlarged by this many cells: edges, blur, and the tremor of a hand.
_BORDER = 2


def without_carrier(recording: Recording, max_frames: int | None = None) -> Recording:
    """A recording whose carrier is ignored, with a note about it; unchanged if there is none.

    Args:
        recording: its files.
        max_frames: maximum number of frames from the start that may be read, or None for all.

    Raises:
        DatasetError: the recording has no frames.
    """
    frames = RecordedDataset(recording, max_frames=max_frames)
    if any(files.depth is None for files in recording.files[:max_frames]):
        return recording
    mask = find_carrier([CellImages.of(frame) for frame in spread_frames(frames)])
    if not mask.any():
        return recording
    return replace(recording, carrier=mask, notes=(*recording.notes, note_about(mask)))


def note_about(carrier: Mask) -> str:
    """A line about a carrier [H, W]."""
    return (
        f"{carrier.mean():.0%} of the image ({_place(carrier)}) moves with the camera: it keeps "
        f"depth and colour while the rest changes, and is neither tracked nor mapped; "
        f"--dataset.no-ignore-carrier maps it"
    )


@dataclass(frozen=True, eq=False)
class CellImages:
    """A frame in cells.

    Attributes:
        depth_m: [H, W] mean depth in metres, 0 where most of a cell is missing.
        rgb: [H, W, 3] mean colour in [0, 1].
    """

    depth_m: NDArray[np.float32]
    rgb: NDArray[np.float32]

    @classmethod
    def of(cls, frame: Frame) -> CellImages:
        """Those of a frame."""
        height, width = frame.depth_m.shape
        size = _CELLS, max(1, round(_CELLS * height / width))
        rgb, depth_m, measured = (
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)
            for image in (frame.rgb, frame.depth_m, (frame.depth_m > 0).astype(np.float32))
        )
        mean_m = np.where(measured >= 0.5, depth_m / np.maximum(measured, 0.5), 0.0)
        return cls(mean_m.astype(np.float32), rgb)


def find_carrier(images: Sequence[CellImages]) -> Mask:
    """Find the cells [H, W] that move with the camera.

    Args:
        images: of one camera, spread over a sequence.
    """
    pairs = _Pairs.of(images)
    if pairs is None:
        return np.zeros((1, 1), bool)
    constant, carrier = np.zeros(pairs.shape, bool), np.zeros(pairs.shape, bool)
    for motion in (_MOTION, _CLEAR_MOTION):
        constant = pairs.constant(~_grown(constant, _BORDER), motion)
        regions = [region for region in pairs.regions(constant) if pairs.is_in_front(region)]
        carrier = np.logical_or.reduce([np.zeros_like(constant), *regions])
        if not carrier.any():
            break
    return _grown(carrier, _BORDER)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """All pairs of some images.

    Attributes:
        depth_m: [N, H, W] of the images.
        both, same: [P, H, W] for each pair, the cells that are measured in both images, and those
            of them that have the same depth and colour.
    """

    depth_m: NDArray[np.float32]
    both: Mask
    same: Mask

    @classmethod
    def of(cls, images: Sequence[CellImages]) -> _Pairs | None:
        """The pairs; None for too few of them."""
        one, other = np.triu_indices(len(images), 1)
        if len(one) < _MIN_PAIRS:
            return None
        depth_m = np.stack([image.depth_m for image in images])
        rgb = np.stack([image.rgb for image in images])
        both = (depth_m[one] > 0) & (depth_m[other] > 0)
        same = both & (np.abs(rgb[one] - rgb[other]) <= _SAME_COLOUR).all(axis=-1)
        nearer = np.minimum(depth_m[one], depth_m[other])
        same &= np.abs(depth_m[one] - depth_m[other]) <= _SAME_DEPTH * nearer
        return cls(depth_m, both, same)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.both.shape[1], self.both.shape[2]

    def constant(self, rest: Mask, motion: float) -> Mask:
        """The cells that are the same in most of the pairs that count.

        Args:
            rest: cells [H, W] of which at least a share of `motion` differs in a pair that counts.
        """
        measured = self.both[:, rest].sum(axis=1)
        differing = measured - self.same[:, rest].sum(axis=1)
        counts = (measured > 0) & (differing >= motion * measured)
        pairs = int(counts.sum())
        if pairs < _MIN_PAIRS:
            return np.zeros(self.shape, bool)
        both, same = self.both[counts].sum(axis=0), self.same[counts].sum(axis=0)
        return np.asarray((both >= _MEASURED * pairs) & (same >= _CONSTANT * both))

    def regions(self, constant: Mask) -> list[Mask]:
        """Connected constant cells [H, W], separated at steps of their depth."""
        depth_m = np.where(constant, self._mean_m, np.float32(0.0))
        is_edge = cv2.dilate(depth_m, np.ones((3, 3))) > _STEP * depth_m
        count, labels = cv2.connectedComponents((constant & ~is_edge).astype(np.uint8))
        regions = [labels == label for label in range(1, count)]
        return [region for region in regions if region.mean() >= _MIN_AREA]

    def is_in_front(self, region: Mask) -> bool:
        """Whether most of the surroundings of a region are farther than its continuation."""
        inverse = np.where(region, 1.0 / np.maximum(self._mean_m, 1e-6), 0.0)
        behind = measured = 0
        for side in range(4):
            inside, d = np.rot90(region, side), np.rot90(inverse, side)
            beyond_m = np.rot90(self.depth_m, side, axes=(1, 2))[:, _INSIDE + _BEYOND :]
            rows = len(inside) - _INSIDE - _BEYOND
            first, edge = d[:rows], d[_INSIDE : _INSIDE + rows]
            border = (first > 0) & (edge > 0) & ~inside[_INSIDE + 1 : _INSIDE + 1 + rows]
            border &= ~inside[_INSIDE + _BEYOND :]
            # A plane is linear in inverse depth.
            continued = edge + np.minimum(_BEYOND / _INSIDE * (edge - first), 0.0)
            seen = border & (beyond_m > 0)
            measured += int(seen.sum())
            behind += int((seen & (beyond_m * continued > _STEP)).sum())
        return behind > _MOST * measured

    @property
    def _mean_m(self) -> NDArray[np.float32]:
        """Mean depth [H, W] over the frames."""
        count = np.maximum((self.depth_m > 0).sum(axis=0), 1)
        return (self.depth_m.sum(axis=0) / count).astype(np.float32)


def _grown(mask: Mask, cells: int) -> Mask:
    size = 2 * cells + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


def _place(mask: Mask) -> str:
    """Where in the image a mask [H, W] is, in words."""
    words = []
    for axis, (first, last) in ((1, ("highest", "lowest")), (0, ("leftmost", "rightmost"))):
        covered = np.flatnonzero(mask.any(axis=axis))
        length = mask.shape[1 - axis]
        if covered[0] == 0 and covered[-1] < length - 1:
            words.append(f"{first} {(covered[-1] + 1) / length:.0%}")
        if covered[0] > 0 and covered[-1] == length - 1:
            words.append(f"{last} {1.0 - covered[0] / length:.0%}")
    if words:
        return " and ".join(words)
    is_around = mask[0].any() and mask[:, 0].any()
    return "around the edges" if is_around else "not at an edge"
