"""What the service answers about a finished run. It is computed from memory; no file is served."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError, SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.resize import ImageGrid
from toolkit.exports.mapped_scene import MappedScene, map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.scene_graph import scene_graph
from toolkit.exports.selection import SelectedGaussians, select
from toolkit.io.guarded.content import read_content
from toolkit.io.guarded.documents import parse_json
from toolkit.io.images import encode_png
from toolkit.io.length_names import LengthNames
from toolkit.io.visualisation import colour_image
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.maps.finished import FinishedRun
from toolkit.scene.graph.scene import SceneReader
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.palette import Palette
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface
from toolkit.tools.serving.requests import QueryParameters, RenderRequest, pose_values

# Depth images: metres = value / scale, 0 where there is no surface.
DEPTH_SCALE = 1000.0
_MAX_DEPTH = 65535
# Answers to queries that are kept.
_CACHED_QUERIES = 256


class NotAvailableError(ToolkitError):
    """The run does not have what was asked for."""


@dataclass(frozen=True)
class _Frame:
    """A tracked frame; `keyframe` is its number among the keyframes, or None."""

    frame: TrackedFrame
    keyframe: int | None

    def values(self) -> dict[str, Any]:
        return {
            "frame": self.frame.index,
            "timestamp_s": self.frame.timestamp_s,
            "keyframe": self.keyframe,
            **pose_values(self.frame.T_map_camera),
        }


class ServedRun:
    """A finished run in memory. Renders and queries may each be called from one thread.

    Args:
        path: the run folder.
        max_pixels: maximum number of pixels of a rendered image.

    Raises:
        ToolkitError: there is no finished run, or a file is damaged.
    """

    def __init__(self, path: Path, max_pixels: int) -> None:
        self._selection: SelectedGaussians = select(path)
        self._run: FinishedRun = self._selection.run
        if not self._run.tracked:
            raise RunFolderError(f"{path} has no frame with a pose; there is nothing to serve")
        self._camera = self._run.camera
        self._max_pixels = max_pixels
        self._renderer = backend(self._run.settings.backend)
        numbers = {index: number for number, index in enumerate(self._run.keyframes)}
        self._frames = [_Frame(f, numbers.get(f.index)) for f in self._run.tracked]
        self._keyframes = {f.keyframe: f for f in self._frames if f.keyframe is not None}
        self._pose_values = [f.values() for f in self._frames]
        self._metrics = _read_metrics(self._run.folder.metrics)
        self._answer = lru_cache(_CACHED_QUERIES)(self._compute_answer)

    @property
    def name(self) -> str:
        """Name of the run folder."""
        return self._run.folder.path.resolve().name

    @property
    def length_names(self) -> LengthNames:
        """How lengths of the map are written."""
        return self._run.length_names

    def description(self) -> dict[str, Any]:
        """Return sizes, camera and class tree of the run."""
        camera, taxonomy = self._camera, self._run.taxonomy
        return {
            "name": self.name,
            "frames": len(self._frames),
            "keyframes": len(self._keyframes),
            "gaussians": len(self._run.gaussians),
            "camera": {
                **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
                "width": camera.width,
                "height": camera.height,
            },
            "metric": self._run.metric,
            "map_origin_m": self._run.origin_m.tolist(),
            "depth_scale": DEPTH_SCALE,
            "max_pixels": self._max_pixels,
            "levels": [] if taxonomy is None else list(taxonomy.levels),
        }

    def poses(self, first: int, count: int, keyframes: bool = False) -> dict[str, Any]:
        """Return a page of the poses of all tracked frames, or of the keyframes."""
        values = self._pose_values
        if keyframes:
            values = [value for value in values if value["keyframe"] is not None]
        return {"total": len(values), "first": first, "poses": values[first : first + count]}

    def metrics(self) -> dict[str, Any]:
        """Return the content of metrics.json.

        Raises:
            NotAvailableError: the run has none.
        """
        if self._metrics is None:
            raise NotAvailableError(
                "the run has no readable metrics.json; write it with: semsplat evaluate RUN"
            )
        return self._metrics

    def classes(self) -> dict[str, Any]:
        """Return the class tree with numbers of Gaussians, and the colours of rendered classes.

        Raises:
            NotAvailableError: the run has no labels.
        """
        reader = self._reader(ObjectOptions())
        palette = Palette(reader.map.taxonomy)
        colours = [
            {
                "path": list(node.path),
                "level": node.level,
                "is_class": node.leaf,
                "rgb": rgb.tolist(),
            }
            for node, rgb in zip(reader.map.taxonomy.nodes, palette.nodes, strict=True)
        ]
        return {"levels": list(reader.map.taxonomy.levels), **reader.tree(), "colours": colours}

    def answer(self, parameters: QueryParameters) -> dict[str, Any]:
        """Answer a query like `semsplat query`.

        Raises:
            NotAvailableError: the run has no labels.
            FormatError: the name is not in the taxonomy, or is ambiguous.
        """
        options = ObjectOptions(
            parameters.link_m, parameters.min_gaussians, parameters.min_confidence
        )
        return self._answer(parameters.name, options)

    def objects(self) -> dict[str, Any]:
        """Return the objects and their relations.

        Raises:
            NotAvailableError: the run has no labels, or no floor was found.
        """
        return self._objects

    def png(self, request: RenderRequest) -> bytes:
        """Render a view and return it as PNG.

        Colour and classes have 8 bits per channel; depth has 16 bits, in units of 1 / DEPTH_SCALE
        of the map's unit of length, 0 where there is no surface.

        Raises:
            NotAvailableError: there is no such keyframe, or the map has no semantics or no such
                level.
            SettingsError: the image is too large, or the pose is not a rigid motion.
        """
        camera = self._camera_of(request)
        features = request.what == "classes"
        if features and self._run.taxonomy is None:
            raise NotAvailableError("the run was mapped without semantics; it has no classes")
        if not features and request.level is not None:
            raise SettingsError("level is for classes only")
        level = self._level(request) if features else 0
        surface = render_surface(
            self._renderer,
            self._run.gaussians,
            camera,
            se3.inverse(self._pose(request)),
            RenderOptions(features=features),
        )
        return encode_png(self._image(request.what, surface, level))

    @cached_property
    def _palette(self) -> Palette:
        assert self._run.taxonomy is not None
        return Palette(self._run.taxonomy)

    @cached_property
    def scene(self) -> MappedScene:
        """Objects, relations and rooms; the first use takes seconds.

        Raises:
            NotAvailableError: the map has no labels, or no floor was found.
        """
        try:
            return map_scene(self._selection, ObjectGraphOptions())
        except ToolkitError as error:
            raise NotAvailableError(self.without_path(error)) from error

    @cached_property
    def _objects(self) -> dict[str, Any]:
        return scene_graph(self.scene).content

    def without_path(self, error: ToolkitError) -> str:
        """Return the message of an error without the paths of this machine."""
        return (
            str(error)
            .replace(f"{self._run.folder.path}/", "")
            .replace(str(self._run.folder.path), "the run")
        )

    def _compute_answer(self, name: str, options: ObjectOptions) -> dict[str, Any]:
        return self._reader(options).answer(name, "GET /classes lists them")

    def _reader(self, options: ObjectOptions) -> SceneReader:
        try:
            labelled = self._selection.labelled()
        except RunFolderError as error:
            raise NotAvailableError(self.without_path(error)) from error
        viewpoint_m = self._run.tracked[0].T_map_camera[:3, 3]
        return SceneReader(labelled, options, viewpoint_m, metric=self._run.metric)

    def _camera_of(self, request: RenderRequest) -> Camera:
        camera = self._camera
        if request.width is not None and request.height is not None:
            if request.width * request.height > self._max_pixels:
                raise SettingsError(
                    f"an image of {request.width}x{request.height} pixels is too large; "
                    f"the limit of this service is {self._max_pixels} pixels"
                )
            camera = ImageGrid(camera, (request.width, request.height)).camera
        elif camera.width * camera.height > self._max_pixels:
            raise SettingsError(
                f"the images of the run have more than {self._max_pixels} pixels, the limit of "
                "this service; give a smaller width and height"
            )
        if request.horizontal_fov_deg is not None:
            focal = 0.5 * camera.width / math.tan(math.radians(request.horizontal_fov_deg) / 2)
            centre = (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
            camera = replace(camera, fx=focal, fy=focal, cx=centre[0], cy=centre[1])
        return camera

    def _pose(self, request: RenderRequest) -> NDArray[np.float64]:
        if request.keyframe is None:
            T_map_camera = request.pose()
            assert T_map_camera is not None
            return T_map_camera
        if request.keyframe not in self._keyframes:
            raise NotAvailableError(
                f"there is no keyframe {request.keyframe} with a pose; the run has "
                f"{len(self._run.keyframes)} keyframes, numbered from 0"
            )
        return self._keyframes[request.keyframe].frame.T_map_camera

    def _level(self, request: RenderRequest) -> int:
        assert self._run.taxonomy is not None
        depth = self._run.taxonomy.depth
        level = depth - 1 if request.level is None else request.level
        if level >= depth:
            raise NotAvailableError(f"there is no level {level}; the levels are 0 to {depth - 1}")
        return level

    def _image(self, what: str, surface: SurfaceView, level: int) -> NDArray[np.integer]:
        if what == "colour":
            return colour_image(surface.output.colour.numpy())
        depth_m = surface.depth_m.numpy()
        if what == "depth":
            values = np.rint(np.nan_to_num(depth_m, posinf=0.0) * DEPTH_SCALE)
            values[(values < 0) | (values > _MAX_DEPTH)] = 0
            return values.astype(np.uint16)
        nodes = self._run.semantics.decode_view_level(surface, level)
        return self._palette.class_image(nodes.reshape(depth_m.shape))


def _read_metrics(path: Path) -> dict[str, Any] | None:
    """Read metrics.json, None if it is missing or damaged: the run can be used without it."""
    try:
        content = parse_json(read_content(path), constant=lambda _: None)
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
