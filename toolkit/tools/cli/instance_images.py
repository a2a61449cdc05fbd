"""Images of the objects of a map, each in a colour of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.class_names import MAX_NAME
from toolkit.io.guarded.documents import read_json
from toolkit.io.splat_labels import instances_in
from toolkit.io.splats import read_splats
from toolkit.io.visualisation import LegendEntry, RgbImage, colour_image
from toolkit.semantics.palette import instance_colours
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

# Distance of visible Gaussians from the rendered surface, relative to its depth.
_ON_SURFACE = 0.03
# Gaussians without an object.
_NO_OBJECT = (60, 60, 60)


@dataclass(frozen=True, eq=False)
class InstanceColours:
    """Gaussians in the colours of their objects.

    Attributes:
        gaussians: the Gaussians of the map in these colours.
        ids: [N] int32 their objects.
        colours: [M + 1, 3] uint8 colour by object; 0 is none.
        names: names of the objects by number, as far as known.
    """

    gaussians: GaussianCloud
    ids: NDArray[np.int32]
    colours: NDArray[np.uint8]
    names: Mapping[int, str]

    @classmethod
    def load(cls, gaussians: GaussianCloud, map_: Path, objects: Path | None) -> InstanceColours:
        """Read the objects of the Gaussians of a splat file.

        Args:
            gaussians: of the map.
            map_: the splat file.
            objects: the file with the classes of the objects, if there is one.

        Raises:
            SettingsError: the map has no objects.
        """
        ids = instances_in(read_splats(map_).extra)
        if ids is None:
            raise SettingsError(
                f"{map_} has no objects; run SLAM again with --instances.kind folder or geometric"
            )
        colours = instance_colours(int(ids.max(initial=0)))
        colours[0] = _NO_OBJECT
        shades = torch.from_numpy(colours[ids].astype(np.float32) / 255.0)
        shapes = None if gaussians.ellipsoids is None else gaussians.ellipsoids.with_degree(0)
        painted = replace(gaussians, colours=shades, ellipsoids=shapes)
        return cls(painted, ids, colours, _names(objects))

    def image(
        self, camera: Camera, T_map_camera: NDArray[np.float64], backend_name: str
    ) -> tuple[RgbImage, list[LegendEntry]]:
        """Render a view, with a legend of the objects in it, largest first."""
        T_camera_map = se3.inverse(T_map_camera)
        render = backend(backend_name)
        view = render_surface(render, self.gaussians, camera, T_camera_map, RenderOptions())
        image = colour_image(view.output.colour.numpy())
        counts = self._visible(camera, T_camera_map, view.depth_m.numpy())
        shown = [int(k) for k in np.argsort(-counts, kind="stable") if k and counts[k]]
        texts = [f"{number} {self.names.get(number, '')}".strip() for number in shown]
        return image, [
            LegendEntry(text, _rgb(self.colours[number]))
            for text, number in zip(texts, shown, strict=True)
        ]

    def _visible(
        self,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        depth_m: NDArray[np.float32],
    ) -> NDArray[np.int64]:
        """Number of Gaussians [M + 1] of each object on the surface [H, W] of a view."""
        means = self.gaussians.means.double().numpy()
        points = se3.transform_points(T_camera_map, means)
        index = np.flatnonzero(points[:, 2] > 0)
        uv = np.rint(camera.project(points[index]))
        inside = (uv >= 0).all(axis=1) & (uv < camera.size).all(axis=1)
        index, (column, row) = index[inside], uv[inside].astype(np.intp).T
        surface_m = depth_m[row, column]
        visible = np.abs(points[index, 2] - surface_m) < _ON_SURFACE * surface_m
        return np.bincount(self.ids[index[visible]], minlength=len(self.colours))


def _rgb(colour: NDArray[np.uint8]) -> tuple[int, int, int]:
    return int(colour[0]), int(colour[1]), int(colour[2])


def _names(file: Path | None) -> dict[int, str]:
    """The classes of objects; none if the file is missing or damaged, since they only label."""
    if file is None or not file.is_file():
        return {}
    try:
        objects = read_json(file)["objects"]
        return {int(o["id"]): str(o["class"])[:MAX_NAME] for o in objects if o["class"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
