"""Quality of splat files of `benchmarks.trainers` on held-out views, and pictures of near views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.real_room import affinely_fitted
from benchmarks.tables import Metrics
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.visualisation import Panel, RgbImage, colour_image, strip
from toolkit.runs.evaluation.images import mean_or_none, psnr_db, ssim_and_ms_ssim
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import render

# A near view is this part of the way to the median depth of a held-out frame.
_APPROACH = 0.6


# Colour behind OpenSplat's maps while they are trained (nerfstudio's).
_BACKGROUND = (0.6130, 0.0101, 0.3984)


@dataclass(frozen=True)
class Look:
    """How a map is rendered: as while it was trained.

    Attributes:
        camera: intrinsics.
        background: red, green and blue in [0, 1] behind the map.
    """

    camera: Camera
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


def trained_look(camera: Camera) -> Look:
    """How OpenSplat's CPU code sees a map: the principal point is the image's centre."""
    centred = replace(camera, cx=(camera.width - 1) / 2, cy=(camera.height - 1) / 2)
    return Look(centred, _BACKGROUND)


def scores(run: FinishedRun, path: Path, look: Look, fitted: bool) -> Metrics:
    """Quality of a splat file on the held-out frames of a run, and its size.

    Args:
        path: of the file, in the frame of the run's map.
        look: how the file is rendered.
        fitted: whether a gain and a bias are fitted to each view.
    """
    cloud, dataset = read_cloud(path), run.open_dataset()
    psnr, ssim = [], []
    for frame in run.tracked:
        if frame.held_out:
            observed = dataset[frame.index].rgb
            rendered = rendered_view(cloud, look, frame.T_map_camera)
            if fitted:
                everywhere = np.ones(observed.shape[:2], bool)
                rendered = affinely_fitted(rendered, observed, everywhere)
            psnr.append(psnr_db(rendered, observed))
            ssim.append(ssim_and_ms_ssim(rendered, observed)[0])
    return {
        "unseen psnr db": mean_or_none(psnr),
        "unseen ssim": mean_or_none(ssim),
        "gaussians": len(cloud),
        "mb": path.stat().st_size / 1e6,
    }


def rendered_view(
    cloud: GaussianCloud, look: Look, T_map_camera: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Colour [H, W, 3] of Gaussians from a camera, before the background of their look."""
    with torch.no_grad():
        output = render(cloud, look.camera, se3.inverse(T_map_camera))
        behind = 1.0 - output.silhouette[..., None]
        colour = output.colour + behind * torch.tensor(look.background)
    return np.asarray(colour.clamp(0.0, 1.0).numpy(), np.float32)


def near_views(run: FinishedRun, maps: Mapping[str, Path], looks: Mapping[str, Look]) -> RgbImage:
    """All maps side by side, from closer to the scene than any held-out frame; rows are views.

    Args:
        maps, looks: splat files and how they are rendered, by caption.
    """
    dataset = run.open_dataset()
    held_out = [frame for frame in run.tracked if frame.held_out]
    chosen = [held_out[len(held_out) // 3], held_out[2 * len(held_out) // 3]]
    clouds = {name: read_cloud(path) for name, path in maps.items()}
    rows = []
    for frame in chosen:
        T_map_camera = approached(frame.T_map_camera, dataset[frame.index].depth_m)
        panels = [
            Panel(name, colour_image(rendered_view(cloud, looks[name], T_map_camera)))
            for name, cloud in clouds.items()
        ]
        rows.append(strip(panels))
    return np.vstack(rows)


def approached(
    T_map_camera: NDArray[np.float64], depth_m: NDArray[np.float32]
) -> NDArray[np.float64]:
    """The pose of a camera that has moved forward, a part of the way to the median depth."""
    known = depth_m[depth_m > 0.0]
    forward = np.eye(4)
    forward[2, 3] = _APPROACH * float(np.median(known)) if len(known) else 0.0
    return T_map_camera @ forward
