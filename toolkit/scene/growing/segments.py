"""The surfaces of objects in one keyframe: connected pixels of one class, or masks of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.regions import connected_regions
from toolkit.base.geometry.voxels import voxel_keys
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.records import KeyframeMasks
from toolkit.scene.instances.voxels import sampled, sampling_step
from toolkit.semantics.colour_names import COLOUR_NAMES

Array = NDArray[np.float64]
Keys = NDArray[np.int64]

# Images are sampled so that about this width remains.
_WIDTH = 80
# Neighbouring pixels whose depths differ by more belong to different surfaces.
_JUMP_M, _JUMP_SHARE = 0.06, 0.06
# Minimum number of sampled pixels of a segment.
_MIN_PIXELS = 7


@dataclass(frozen=True)
class Segments:
    """Segments of a keyframe, numbered from 1, on sampled pixels.

    Attributes:
        ids: [h, w] int32 segment of each sampled pixel, 0 for none.
        class_ids: [S] class of each segment; 0 if it is unknown.
        objects: [S] number of the object of each segment, 0 if it is to be found.
        step: distance between sampled pixels.
    """

    ids: NDArray[np.int32]
    class_ids: NDArray[np.int32]
    objects: NDArray[np.int32]
    step: int

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.class_ids)


@dataclass(frozen=True)
class SegmentVoxels:
    """The voxels of one segment.

    Attributes:
        keys: [E] ascending numbers of its voxels.
        sums_m: [E, 5] sum of the points in each voxel, their number, and 1.
        colours: [K] pixels with each colour name.
    """

    keys: Keys
    sums_m: Array
    colours: NDArray[np.int64]


def labelled_segments(keyframe: Keyframe) -> Segments | None:
    """Connected pixels of one class without jumps of depth; None without labels."""
    if keyframe.class_ids is None:
        return None
    step = max(1, round(keyframe.camera.width / _WIDTH))
    labels = sampled(keyframe.class_ids.numpy(), step).astype(np.int32)
    depth_m = sampled(keyframe.depth_m.numpy(), step)
    labels = np.where((depth_m > 0) & ~_jumps(depth_m), labels, 0)
    ids, found = connected_regions(labels, min_pixels=_MIN_PIXELS)
    return Segments(ids, found, np.zeros(len(found), np.int32), step)


def masked_segments(
    keyframe: Keyframe, record: KeyframeMasks, objects: NDArray[np.int32], classes: NDArray
) -> Segments:
    """The masks of a keyframe as segments of known objects.

    Args:
        record: masks of the keyframe.
        objects: [K] current object of each mask, 0 for none.
        classes: [K] class of each object, 0 if it is unknown.
    """
    step = sampling_step(keyframe.camera.width)
    # Every second sample suffices: voxels are larger than masks need.
    depth_m = sampled(keyframe.depth_m.numpy(), 2 * step)
    rows, columns = (
        np.minimum(2 * np.arange(count) + 1, samples - 1)
        for count, samples in zip(depth_m.shape, record.shape, strict=True)
    )
    ids = record.ids[rows[:, None], columns]
    ids = np.where((depth_m > 0) & ~_jumps(depth_m), ids, 0)
    kept = (objects > 0) & (classes > 0)
    table = np.append(0, np.where(kept, np.arange(1, len(kept) + 1), 0)).astype(np.int32)
    return Segments(table[ids], classes.astype(np.int32), objects, 2 * step)


def voxels_of_segments(
    segments: Segments,
    keyframe: Keyframe,
    voxels_m: NDArray[np.float64],
    metres_per_unit: float,
    colours: NDArray[np.uint8],
) -> dict[int, SegmentVoxels]:
    """Return the voxels of each segment in the frame of the submap, in metres.

    Args:
        voxels_m: [S] edge of the voxels of each segment.
        metres_per_unit: length of the unit of the keyframe.
        colours: [32, 32, 32] number of the name of each colour.
    """
    step = segments.step
    chosen = np.flatnonzero(segments.ids.reshape(-1) > 0)
    if not len(chosen):
        return {}
    local = keyframe.camera.unproject(keyframe.depth_m.numpy(), step).reshape(-1, 3)[chosen]
    points = se3.transform_points(keyframe.T_map_camera, local) * metres_per_unit
    owner = segments.ids.reshape(-1)[chosen].astype(np.int64)
    keys = voxel_keys(np.floor(points / voxels_m[owner - 1, None]).astype(np.int64))
    order = np.lexsort((keys, owner))
    owner, keys = owner[order], keys[order]
    rgb = sampled(keyframe.rgb.numpy(), step).reshape(3, -1)[:, chosen] >> 3
    names = colours[rgb[0], rgb[1], rgb[2]].astype(np.int64)[order]
    kinds = len(COLOUR_NAMES)
    histograms = np.bincount(owner * kinds + names, minlength=(len(voxels_m) + 1) * kinds)
    histograms = histograms.reshape(-1, kinds)
    first = np.flatnonzero((np.diff(owner, prepend=0) != 0) | (np.diff(keys, prepend=0) != 0))
    sums = np.column_stack([points, np.ones((len(points), 2))])[order]
    totals = np.add.reduceat(sums, first, axis=0)
    totals[:, 4] = 1.0
    owner, keys = owner[first], keys[first]
    starts = np.flatnonzero(np.diff(owner, prepend=0))
    found = {}
    for a, b in zip(starts, np.append(starts[1:], len(owner)), strict=True):
        number = int(owner[a])
        found[number] = SegmentVoxels(keys[a:b], totals[a:b], histograms[number])
    return found


def _jumps(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels [h, w] beside which depth jumps."""
    limit_m = _JUMP_M + _JUMP_SHARE * depth_m
    jump = np.zeros(depth_m.shape, bool)
    jump[:, :-1] = np.abs(np.diff(depth_m, axis=1)) > limit_m[:, :-1]
    jump[:-1] |= np.abs(np.diff(depth_m, axis=0)) > limit_m[:-1]
    return jump
