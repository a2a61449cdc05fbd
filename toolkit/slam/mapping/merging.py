"""Merging: spheres on one patch of a surface become one ellipsoid.

Tracking needs spheres of the size of a pixel. Once it has ended, a patch of one colour and class
becomes one ellipsoid, with the mean and the covariance of the spheres that it replaces.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER, GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids, quaternions

Array = NDArray[np.float64]

# Side of a patch in pixels of the keyframe that seeded its Gaussians, and its maximum as a fraction
# of the geometric mean of width and height: pixels of small images show more detail. At 160x120, a
# side of 5 pixels loses 1 dB against spheres, and one of 2.5 gains 0.6 dB.
PATCH_PX, _MAX_FRACTION = 6.0, 1 / 48
# Steps of the colours in [0, 1] that are kept apart: smaller than most edges, larger than noise.
_COLOUR_STEP = 0.125
# Bounds of the merged opacity, whose logit must be finite.
_OPACITIES = 0.01, 0.99
_SMALLEST_M = 1e-5
# A Gaussian with the covariance of a patch leaves gaps to its neighbours. With this factor of its
# two larger axes, the merged map starts 5 dB better. With 1.3, rooms gain another 0.3 dB, and the
# depth error of the HoloLens walk grows by a third.
_IN_PLANE = 1.15
# Of the numbers of patches, which are 64-bit integers.
_MAX_NUMBER = 2**62


def to_ellipsoids(submap: Submap, classes: Tensor, low_pass: LowPass = PIXEL_FILTER) -> None:
    """Merge the spheres of a submap; its optimiser starts again.

    Args:
        classes: [N] class ids, which are kept apart.
        low_pass: of the ellipsoids.
    """
    cloud = submap.gaussians
    if not len(cloud):
        return
    patches = _patches(cloud, _patch_sizes(submap), classes.cpu().numpy())
    merged, heaviest = _merged(cloud, patches, low_pass)
    submap.gaussians = merged
    submap.seeded_by = submap.seeded_by.index_select(0, heaviest)
    steps = submap.optimiser.steps.index_select(0, heaviest)
    submap.optimiser = OptimiserState(steps)


def _patch_sizes(submap: Submap) -> Array:
    """Side [N] in metres of a patch around each Gaussian, by its seeding keyframe."""
    centres = {k.index: k.T_map_camera[:3, 3] for k in submap.keyframes}
    means, sources = submap.gaussians.means.cpu().double().numpy(), submap.seeded_by.cpu().numpy()
    known, inverse = np.unique(sources, return_inverse=True)
    nearest = submap.keyframes[0].T_map_camera[:3, 3]
    positions = np.array([centres.get(int(index), nearest) for index in known])
    distances = np.linalg.norm(means - positions[inverse.reshape(-1)], axis=1)
    camera = submap.keyframes[0].camera
    side_px = min(PATCH_PX, _MAX_FRACTION * math.sqrt(camera.width * camera.height))
    return side_px * distances / camera.focal


def _patches(cloud: GaussianCloud, sizes_m: Array, classes: NDArray) -> NDArray[np.int64]:
    """Number [N] of the patch of each Gaussian: a cell of space, a colour and a class."""
    means = cloud.means.cpu().double().numpy()
    # Powers of two, so that neighbours usually share their grid.
    levels = np.rint(np.log2(np.maximum(sizes_m, _SMALLEST_M)))
    cells = _numbers(np.floor(means / np.exp2(levels)[:, None]), levels)
    # Cells with several classes are halved: borders between classes stay sharp.
    levels -= _is_mixed(cells, classes)
    cells = np.floor(means / np.exp2(levels)[:, None])
    colours = np.floor(cloud.colours.cpu().double().numpy() / _COLOUR_STEP)
    return _numbers(cells, levels, colours, classes)


def _numbers(*keys: NDArray) -> NDArray[np.int64]:
    """Number [N] of each distinct row of some columns [N] or [N, K] of integers."""
    rows = np.column_stack(keys).astype(np.int64)
    rows -= rows.min(axis=0)
    numbers, bound = np.zeros(len(rows), np.int64), 1
    # Several times faster than `np.unique` over rows, which sorts them as bytes.
    for column in rows.T:
        span = int(column.max()) + 1
        if bound * span > _MAX_NUMBER:
            numbers = np.unique(numbers, return_inverse=True)[1]
            bound = int(numbers.max()) + 1
        numbers, bound = numbers * span + column, bound * span
    return np.unique(numbers, return_inverse=True)[1]


def _is_mixed(cells: NDArray[np.int64], classes: NDArray) -> NDArray[np.bool_]:
    """Mask [N] of the Gaussians in cells with numbers [N] that contain several classes."""
    first = np.unique(_numbers(cells, classes), return_index=True)[1]
    return np.asarray(np.bincount(cells[first])[cells] > 1)


def _merged(
    cloud: GaussianCloud, patches: NDArray[np.int64], low_pass: LowPass
) -> tuple[GaussianCloud, Tensor]:
    """Return one ellipsoid for each patch, and the index [M] of its heaviest sphere."""
    weights = (cloud.opacities * cloud.radii_m**2).cpu().double().numpy() + 1e-12
    total = np.bincount(patches, weights)

    def mean(values: Tensor | NDArray) -> Array:
        columns = np.asarray(values, dtype=np.float64).reshape(len(patches), -1).T
        return np.stack([np.bincount(patches, weights * c) / total for c in columns], axis=1)

    means = mean(cloud.means.cpu())
    offsets = cloud.means.cpu().double().numpy() - means[patches]
    spread = offsets[:, :, None] * offsets[:, None, :]
    spread += (cloud.radii_m.cpu().double().numpy() ** 2)[:, None, None] * np.eye(3)
    variances, axes = np.linalg.eigh(mean(spread.reshape(-1, 9)).reshape(-1, 3, 3))
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    variances[np.bincount(patches) > 1, 1:] *= _IN_PLANE**2
    log_scales = _tensor(0.5 * np.log(np.maximum(variances, _SMALLEST_M**2)), cloud)
    opacities = _tensor(mean(cloud.opacities.cpu()).clip(*_OPACITIES)[:, 0], cloud)
    # Degree 1: +0.15 dB on unseen views of a kitchen, nothing in a glossy room, larger files.
    harmonics = cloud.means.new_zeros(len(total), 0, 3)
    features = _tensor(mean(cloud.features.cpu()), cloud) if cloud.features.shape[1] else None
    merged = GaussianCloud(
        _tensor(means, cloud),
        log_scales.mean(dim=1),
        torch.logit(opacities),
        _tensor(mean(cloud.colours.cpu()), cloud),
        cloud.features.new_zeros(len(total), 0) if features is None else features,
        ellipsoids=Ellipsoids(log_scales, _tensor(quaternions(axes), cloud), harmonics),
        centred_colours=cloud.centred_colours,
        low_pass=low_pass,
    )
    order = np.lexsort((-weights, patches))
    first = np.searchsorted(patches[order], np.arange(len(total)))
    return merged, torch.from_numpy(order[first]).to(cloud.means.device)


def _tensor(values: Array, cloud: GaussianCloud) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(cloud.means.device)
