"""Meshes of a map, or of some of its Gaussians, as the run's camera would have seen them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from toolkit.cli.finished_run import FinishedRun
from toolkit.errors import SettingsError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.io.meshes import DepthView, TriangleMesh, fuse_views
from toolkit.rendering import backend, draw_surface

# Rendered pixels thinner than this show no surface.
_LEAST_SILHOUETTE = 0.9


@dataclass(frozen=True)
class MeshOptions:
    """How a mesh is fused from renders.

    Attributes:
        voxel_m: edge of a voxel, metres.
        max_depth_m: farthest depth that enters, metres.
        every: of the run's poses, every n-th is drawn.

    Raises:
        SettingsError: one of them is not positive.
    """

    voxel_m: float
    max_depth_m: float
    every: int

    def __post_init__(self) -> None:
        for name in ("voxel_m", "max_depth_m", "every"):
            value = getattr(self, name)
            if not value > 0:
                raise SettingsError(f"--{name.replace('_', '-')} must be positive, got {value}")


def surface_mesh(run: FinishedRun, gaussians: GaussianCloud, options: MeshOptions) -> TriangleMesh:
    """The surface of Gaussians, fused from their depth and colour at the run's poses.

    Args:
        run: gives camera, poses and renderer.
        gaussians: the run's map or a part of it, drawn alone: what would hide it is not there.

    Raises:
        ToolkitError: the data set is not at hand, or nothing is near enough.
    """
    views = _views(run, gaussians, options.every)
    return fuse_views(views, options.voxel_m, options.max_depth_m)


def _views(run: FinishedRun, gaussians: GaussianCloud, every: int) -> Iterator[DepthView]:
    camera = run.open_dataset().camera
    frames = run.tracked[::every]
    for frame in tqdm(frames, unit="view", file=sys.stderr, disable=not sys.stderr.isatty()):
        drawn = draw_surface(
            backend(run.settings.backend),
            gaussians,
            camera,
            se3.inverse(frame.T_map_camera),
            _LEAST_SILHOUETTE,
        )
        rgb = np.clip(drawn.output.colour.numpy(), 0.0, 1.0)
        yield DepthView(camera, frame.T_map_camera, rgb, drawn.depth_m.numpy())
