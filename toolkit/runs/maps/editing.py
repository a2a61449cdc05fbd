"""Edit labelled maps by class: remove, keep, move, recolour; measure the holes left behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.splats import read_splats
from toolkit.runs.maps.labelled import LabelledRun
from toolkit.scene.graph.boxes import Ground, floor_area_m2
from toolkit.scene.query import FLOOR_NAMES
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface

# A pixel with a smaller silhouette (0-1) shows no surface.
_MIN_SILHOUETTE = 0.5
# Gaussians at most this high above the floor, or below it, close a hole in it.
_FLOOR_M = 0.1
_CELL_M = 0.05


@dataclass(frozen=True)
class Shift:
    """A motion of a class or group: metres to the right, down and forward of the first camera."""

    name: str
    offset_m: tuple[float, float, float]


@dataclass(frozen=True)
class Paint:
    """A new colour of a class or group, RGB in [0, 1]; differences in brightness are kept."""

    name: str
    rgb: tuple[float, float, float]


@dataclass(frozen=True)
class Edits:
    """Changes of a map; all names refer to the original map.

    Attributes:
        remove, keep: classes and groups to remove, and to keep (empty: all).
        shifts, paints: motions and new colours.
        min_confidence: minimum confidence of the labels by which Gaussians are selected, in [0, 1].
    """

    remove: Sequence[str] = ()
    keep: Sequence[str] = ()
    shifts: Sequence[Shift] = ()
    paints: Sequence[Paint] = ()
    min_confidence: float = 0.0


@dataclass(frozen=True)
class EditedMap:
    """The result of edits.

    Attributes:
        gaussians: M Gaussians.
        columns: additional columns [M] of the splat file.
        removed, moved, recoloured: masks [N] of the original Gaussians.
        floor_hole_m2: area of the floor below removed and moved Gaussians that the map does not
            contain, in square metres; None if no floor was found.
    """

    gaussians: GaussianCloud
    columns: dict[str, NDArray]
    removed: NDArray[np.bool_]
    moved: NDArray[np.bool_]
    recoloured: NDArray[np.bool_]
    floor_hole_m2: float | None


def edit(labelled: LabelledRun, edits: Edits) -> EditedMap:
    """Apply edits to the map of a run.

    Raises:
        ToolkitError: a name is not in the taxonomy or has no Gaussians, or nothing is left.
    """
    run = labelled.run

    def selected(names: Sequence[str]) -> NDArray[np.bool_]:
        return labelled.select(names, edits.min_confidence)

    removed = selected(edits.remove)
    if edits.keep:
        removed |= ~selected(edits.keep)
    if removed.all():
        raise ToolkitError(f"the edits remove all Gaussians of {run.folder.path}")
    means, colours = run.gaussians.means.clone(), run.gaussians.colours.clone()
    ellipsoids = run.gaussians.ellipsoids
    moved, recoloured = np.zeros_like(removed), np.zeros_like(removed)
    R_map_first = run.tracked[0].T_map_camera[:3, :3] if run.tracked else np.eye(3)
    for shift in edits.shifts:
        mask = selected([shift.name])
        offset_m = R_map_first @ np.array(shift.offset_m)
        means[torch.from_numpy(mask)] += torch.tensor(offset_m, dtype=means.dtype)
        moved |= mask
    for paint in edits.paints:
        mask = selected([paint.name])
        index = torch.from_numpy(mask)
        if ellipsoids is not None:
            harmonics = ellipsoids.harmonics.clone()
            harmonics[index] = painted_harmonics(harmonics[index], colours[index], paint.rgb)
            ellipsoids = replace(ellipsoids, harmonics=harmonics)
        colours[index] = painted(colours[index], paint.rgb)
        recoloured |= mask
    kept = torch.from_numpy(~removed)
    changed = replace(run.gaussians, means=means, colours=colours, ellipsoids=ellipsoids)
    gaussians = changed.select(kept)
    extra = read_splats(run.folder.map).extra
    return EditedMap(
        gaussians,
        {name: column[~removed] for name, column in extra.items()},
        removed,
        moved & ~removed,
        recoloured & ~removed,
        _floor_hole_m2(labelled, removed | moved, gaussians),
    )


def painted(colours: torch.Tensor, rgb: tuple[float, float, float]) -> torch.Tensor:
    """Return colours [N, 3] of a new hue whose brightness varies as that of the old ones."""
    brightness = colours.mean(dim=1, keepdim=True)
    shading = brightness / _typical_brightness(colours)
    return (shading * torch.tensor(rgb, dtype=colours.dtype)).clamp(0.0, 1.0)


def painted_harmonics(
    harmonics: torch.Tensor, colours: torch.Tensor, rgb: tuple[float, float, float]
) -> torch.Tensor:
    """Return harmonics [N, K, 3] of a new hue, with which brightness depends on the view as before.

    Args:
        harmonics: the old ones.
        colours: [N, 3] the old colours.
        rgb: the new hue.
    """
    shading = harmonics.mean(dim=2, keepdim=True) / _typical_brightness(colours)
    return shading * torch.tensor(rgb, dtype=harmonics.dtype)


def _typical_brightness(colours: torch.Tensor) -> torch.Tensor:
    return colours.mean(dim=1).median().clamp(min=1e-3)


def _floor_hole_m2(
    labelled: LabelledRun, gone: NDArray[np.bool_], rest: GaussianCloud
) -> float | None:
    """Return the area of the floor below Gaussians that is not part of the remaining map."""
    ground = labelled.map.ground(FLOOR_NAMES)
    if ground is None:
        return None
    if not gone.any():
        return 0.0
    remaining_m = rest.means.numpy().astype(np.float64)
    on_floor = remaining_m @ ground.up - ground.height_m <= _FLOOR_M
    known = _cells(remaining_m[on_floor], ground)
    points_m = labelled.map.means_m[gone]
    open_ = ~np.isin(_cells(points_m, ground), known)
    return floor_area_m2(points_m[open_], ground) if open_.any() else 0.0


def _cells(points_m: NDArray[np.float64], ground: Ground) -> NDArray[np.int64]:
    cells = np.floor(points_m @ ground.axes[:, :2] / _CELL_M).astype(np.int64)
    return np.asarray((cells[:, 0] << 32) + cells[:, 1])


@dataclass(frozen=True)
class EditedView:
    """One view of a map before and after the edits.

    Attributes:
        before, after: colours [H, W, 3].
        hole: [H, W] pixels that showed a surface and show nothing now.
        hole_m2: area of these pixels at the depth of the surface that was removed.
    """

    before: NDArray[np.float32]
    after: NDArray[np.float32]
    hole: NDArray[np.bool_]
    hole_m2: float

    @property
    def hole_percent(self) -> float:
        """Share of the pixels in holes."""
        return 100.0 * float(self.hole.mean())


def view_edit(
    labelled: LabelledRun, edited: EditedMap, camera: Camera, T_map_camera: NDArray[np.float64]
) -> EditedView:
    """Render a view of both maps and compare what they show."""

    def rendered(gaussians: GaussianCloud) -> SurfaceView:
        renderer = backend(labelled.run.settings.backend)
        T_camera_map = se3.inverse(T_map_camera)
        options = RenderOptions(_MIN_SILHOUETTE)
        return render_surface(renderer, gaussians, camera, T_camera_map, options)

    before, after = rendered(labelled.run.gaussians), rendered(edited.gaussians)
    filled = (before.output.silhouette >= _MIN_SILHOUETTE).numpy()
    hole = filled & (after.output.silhouette < _MIN_SILHOUETTE).numpy()
    depth_m = before.depth_m.numpy().astype(np.float64)
    area_m2 = float((depth_m[hole] ** 2).sum()) / (camera.fx * camera.fy)
    return EditedView(before.output.colour.numpy(), after.output.colour.numpy(), hole, area_m2)
