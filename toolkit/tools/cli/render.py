"""`semsplat render`: render views of a map to PNG, or a video."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.pose_splines import pose_spline, thinned
from toolkit.datasets.base import Dataset
from toolkit.datasets.resize import ImageGrid
from toolkit.io.atomic import cannot_write
from toolkit.io.images import write_png
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import SUFFIXES, is_splat_file, read_splats
from toolkit.io.trajectories import read_tum
from toolkit.io.video_writing import write_video
from toolkit.io.visualisation import (
    DepthSpan,
    RgbImage,
    colour_image,
    depth_image,
    silhouette_image,
    view_strip,
    with_depth_scale,
    with_legend,
)
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.runs.maps.splat_clouds import cloud_of
from toolkit.semantics.palette import Palette
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, backend, render_surface
from toolkit.splatting.rendering.viewpoints import Viewpoint, overview
from toolkit.tools.cli.instance_images import InstanceColours
from toolkit.tools.cli.programs import SEMANTIC_IMAGES, RenderProgram

_log = logging.getLogger(__name__)

# Minimum silhouette (0-1) of pixels with a surface.
_MIN_SILHOUETTE = 0.5
_LEGEND_ROWS = 8
# Number of views rendered in advance to determine the range of the depth colours.
_SPAN_VIEWS = 8
# Minimum step between keyframes that a video passes through: 20 cm, or about 16 degrees.
_MIN_KNOT_STEP = 0.2
# For splat files without a given camera: about 60 degrees wide, as most RGB-D cameras.
_DEFAULT_CAMERA = Camera(fx=550.0, fy=550.0, cx=319.5, cy=239.5, width=640, height=480)


@dataclass(frozen=True)
class _Map:
    """The map to render, and the run that created it if known.

    Attributes:
        names: how lengths are written.
        labels: whether labels are rendered.
        instances: the map in the colours of its objects, None unless they are rendered.
    """

    gaussians: GaussianCloud
    run: FinishedRun | None
    backend_name: str
    names: LengthNames
    labels: bool = False
    instances: InstanceColours | None = None


@dataclass(frozen=True)
class _View:
    """One view to render: the number in its file names, its pose, and its frame if it has one."""

    number: int
    T_map_camera: NDArray[np.float64]
    frame_index: int | None = None


@dataclass(frozen=True)
class _RenderedView:
    """Images of one view.

    Attributes:
        rgb: [H, W, 3]. depth_m: [H, W] surface depth, 0 where missing. silhouette: [H, W].
        nodes: [L, H, W] nodes of the taxonomy, or None.
    """

    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    silhouette: NDArray[np.float32]
    nodes: NDArray[np.int32] | None = None


def main(options: RenderProgram) -> int:
    """Render views.

    Returns:
        0.

    Raises:
        ToolkitError: the map, trajectory or dataset cannot be read, or the output folder cannot
            be written.
    """
    map_ = _load(options)
    palette = _palette(map_)
    camera = _camera(options, map_.run)
    if options.video is not None:
        return _write_video(options, map_, camera, palette)
    inputs = _InputImages.open(options, map_.run, camera)
    views = _views(options, map_, camera)[:: options.every]
    out = _create_output_folder(options)

    step = max(1, len(views) // _SPAN_VIEWS)
    span = DepthSpan.of(_render(map_, camera, view).depth_m for view in views[::step])
    for view in tqdm(views, unit="view", disable=None):
        rendered = _render(map_, camera, view)
        observed = inputs.rgb(view) if inputs else None
        images: dict[str, RgbImage] = {
            kind: _image_of(kind, rendered, span, observed, map_.names)
            for kind in options.what
            if kind not in SEMANTIC_IMAGES and kind != "instances"
        }
        if map_.instances is not None:
            shown = map_.instances.image(camera, view.T_map_camera, map_.backend_name)
            images["instances"] = with_legend(*shown)
        if palette is not None:
            images |= _label_images(options.what, palette, rendered)
        for name, image in images.items():
            write_png(out / f"{name}_{view.number:06d}.png", image)
    print(f"rendered {len(views)} view(s) to {out}")
    return 0


def _write_video(
    options: RenderProgram, map_: _Map, camera: Camera, palette: Palette | None
) -> int:
    """Render a video on a smooth path."""
    assert options.video is not None
    count = max(2, round(options.video_s * options.video_fps))
    path = pose_spline(_knots(options, map_, camera), count)
    views = [_View(number, T_map_camera) for number, T_map_camera in enumerate(path)]
    step = max(1, count // _SPAN_VIEWS)
    span = DepthSpan.of(_render(map_, camera, view).depth_m for view in views[::step])
    kind = options.what[0]

    def images() -> Iterator[RgbImage]:
        for view in tqdm(views, unit="view", disable=None):
            rendered = _render(map_, camera, view)
            if kind == "instances" and map_.instances is not None:
                yield map_.instances.image(camera, view.T_map_camera, map_.backend_name)[0]
            elif palette is None or rendered.nodes is None:
                yield _image_of(kind, rendered, span, None, map_.names)
            elif kind == "labels":
                yield palette.class_image(rendered.nodes[-1])
            else:
                rgb = np.clip(rendered.rgb, 0.0, 1.0)
                yield palette.level_strip(rgb, list(rendered.nodes))

    write_video(options.video, images(), options.video_fps)
    print(f"rendered {count} view(s) to {options.video}")
    return 0


def _knots(options: RenderProgram, map_: _Map, camera: Camera) -> NDArray[np.float64]:
    """Return the poses [N, 4, 4] that the path of a video passes through."""
    run = map_.run
    if options.trajectory is not None or options.view:
        views = _views(options, map_, camera)[:: options.every]
        return np.array([view.T_map_camera for view in views])
    if run is None or not run.tracked:
        raise SettingsError(
            f"{options.map} has no keyframes for the path of the video; give --view or --trajectory"
        )
    keyframes = set(run.keyframes)
    poses = [f.T_map_camera for f in run.tracked if f.index in keyframes]
    return thinned(np.array(poses or [run.tracked[0].T_map_camera]), _MIN_KNOT_STEP)


def _load(options: RenderProgram) -> _Map:
    path, labels = options.map, bool(SEMANTIC_IMAGES & set(options.what))
    if is_splat_file(path):
        splats = read_splats(path)
        cloud, names = cloud_of(splats), LengthNames.of_comments(splats.comments)
        instances = _instances(options, cloud, path, None)
        return _Map(cloud, None, "auto", names, instances=instances)
    if not path.exists():
        raise DatasetError(
            f"{path} does not exist; give a run folder or a {', '.join(SUFFIXES)} file"
        )
    run = load_run(path)
    if labels and run.taxonomy is None:
        raise SettingsError(
            f"{path} was mapped without semantics; run SLAM again with --semantics.code.kind"
        )
    folder = run.folder
    instances = _instances(options, run.gaussians, folder.map, folder.objects)
    names = run.length_names
    return _Map(run.gaussians, run, run.settings.backend, names, labels, instances)


def _instances(
    options: RenderProgram, gaussians: GaussianCloud, map_: Path, objects: Path | None
) -> InstanceColours | None:
    """The map in the colours of its objects, None unless they are rendered."""
    if "instances" not in options.what:
        return None
    return InstanceColours.load(gaussians, map_, objects)


def _palette(map_: _Map) -> Palette | None:
    if not map_.labels or map_.run is None or map_.run.taxonomy is None:
        return None
    return Palette(map_.run.taxonomy)


@dataclass(frozen=True)
class _InputImages:
    """The recorded images that strips show beside the rendered images."""

    dataset: Dataset
    grid: ImageGrid | None

    @classmethod
    def open(
        cls, options: RenderProgram, run: FinishedRun | None, camera: Camera
    ) -> _InputImages | None:
        """Open the dataset of a run, None if no strip needs it or it is not available."""
        if run is None or options.camera is not None or "strip" not in options.what:
            return None
        try:
            dataset = run.open_dataset()
        except DatasetError as error:
            _log.warning("Strips are rendered without input images: %s.", error)
            return None
        resized = camera.size != dataset.camera.size
        return cls(dataset, ImageGrid(dataset.camera, camera.size) if resized else None)

    def rgb(self, view: _View) -> NDArray[np.float32] | None:
        """Return the image [H, W, 3] recorded at a view, None if there is none."""
        if view.frame_index is None:
            return None
        rgb = self.dataset[view.frame_index].rgb
        return self.grid.colour(rgb) if self.grid else rgb


def _camera(options: RenderProgram, run: FinishedRun | None) -> Camera:
    """Return the camera of the options, by default that of the run."""
    size = options.image_size
    if options.camera is not None:
        fx, fy, cx, cy = options.camera
        size = size or (run.settings.image_size if run else None)
        # Without a size, the principal point is assumed to be the image centre.
        width, height = size or (round(2 * cx + 1), round(2 * cy + 1))
        return Camera(fx, fy, cx, cy, width, height)
    if run is not None:
        return ImageGrid(run.camera, size).camera if size else run.camera
    width, height = size or _DEFAULT_CAMERA.size
    focal = _DEFAULT_CAMERA.fx * width / _DEFAULT_CAMERA.width
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _views(options: RenderProgram, map_: _Map, camera: Camera) -> list[_View]:
    run = map_.run
    if options.trajectory is not None:
        poses = read_tum(options.trajectory).T_world_camera
        return [_View(number, T) for number, T in enumerate(poses)]
    if options.view:
        T_map_first = run.tracked[0].T_map_camera if run and run.tracked else np.eye(4)
        return [
            _View(number, T_map_first @ _viewpoint(view).T_map_camera)
            for number, view in enumerate(options.view)
        ]
    if run is not None:
        return [_View(frame.index, frame.T_map_camera, frame.index) for frame in run.tracked]
    return [_View(0, overview(map_.gaussians, camera))]


def _viewpoint(view: tuple[float, float, float, float, float]) -> Viewpoint:
    x, y, z, yaw_deg, pitch_deg = view
    return Viewpoint((x, y, z), math.radians(yaw_deg), math.radians(pitch_deg))


def _create_output_folder(options: RenderProgram) -> Path:
    out = options.out
    if out is None:
        path = options.map
        out = path / "renders" / "views" if path.is_dir() else path.with_name(f"{path.stem}_views")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(out, error) from error
    return out


def _render(map_: _Map, camera: Camera, view: _View) -> _RenderedView:
    surface = render_surface(
        backend(map_.backend_name),
        map_.gaussians,
        camera,
        se3.inverse(view.T_map_camera),
        RenderOptions(_MIN_SILHOUETTE, features=map_.labels),
    )
    depth_m, output = surface.depth_m.numpy(), surface.output
    nodes = None
    if map_.labels and map_.run is not None:
        nodes = map_.run.semantics.decode_view(surface).nodes.T.reshape(-1, *depth_m.shape)
    return _RenderedView(output.colour.numpy(), depth_m, output.silhouette.numpy(), nodes)


def _label_images(
    what: Sequence[str], palette: Palette, rendered: _RenderedView
) -> dict[str, RgbImage]:
    """Return images of the taxonomy's levels by the prefix of their file name."""
    assert rendered.nodes is not None
    images = {}
    if "labels" in what:
        for level, nodes in enumerate(rendered.nodes):
            image = with_legend(palette.class_image(nodes), palette.legend(nodes))
            images[f"labels_l{level}"] = image
    if "levels" in what:
        rgb = np.clip(rendered.rgb, 0.0, 1.0)
        strip = palette.level_strip(rgb, list(rendered.nodes), legend_rows=_LEGEND_ROWS)
        images["levels"] = strip
    return images


def _image_of(
    kind: str,
    rendered: _RenderedView,
    span: DepthSpan,
    observed: NDArray[np.float32] | None,
    names: LengthNames,
) -> RgbImage:
    if kind == "colour":
        return colour_image(rendered.rgb)
    if kind == "depth":
        return with_depth_scale(depth_image(rendered.depth_m, span), span, names)
    if kind == "silhouette":
        return silhouette_image(rendered.silhouette)
    strip = (rendered.rgb, rendered.depth_m, rendered.silhouette)
    return view_strip(*strip, observed, span, names)
