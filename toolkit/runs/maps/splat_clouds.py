"""Splat files as Gaussians."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import torch

from toolkit.io.splats import Splats, read_splats
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, PIXEL_FILTER, GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import SHAPES, Ellipsoids


def read_cloud(path: str | os.PathLike[str]) -> GaussianCloud:
    """Read the Gaussians of a splat file, in any of the formats of `read_splats`.

    Raises:
        DatasetError: the file is missing.
        FormatError: it is not a splat file.
    """
    return cloud_of(read_splats(path))


def cloud_of(splats: Splats) -> GaussianCloud:
    """The Gaussians of a splat file."""
    arrays = (splats.means, splats.log_radii, splats.opacity_logits, splats.colours)
    means, log_radii, opacity_logits, colours = (
        torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32)) for a in arrays
    )
    cloud = GaussianCloud(means, log_radii, opacity_logits, colours, means.new_zeros(len(means), 0))
    if splats.ellipsoids is None:
        return cloud
    tensors = (torch.from_numpy(getattr(splats.ellipsoids, name)) for name in SHAPES)
    return replace(
        cloud,
        ellipsoids=Ellipsoids(*tensors),
        low_pass=PIXEL_FILTER if splats.pixel_filter else LOW_PASS_3DGS,
    )
