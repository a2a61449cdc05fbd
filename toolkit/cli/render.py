"""`semsplat render`: draw views of a map to PNG."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import RenderProgram
from toolkit.datasets.base import Dataset
from toolkit.datasets.resize import ImageGrid
from toolkit.errors import DatasetError, SettingsError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.atomic import cannot_write
from toolkit.io.images import write_png
from toolkit.io.pictures import (
    DepthSpan,
    Picture,
    colour_picture,
    depth_picture,
    silhouette_picture,
    view_strip,
    with_depth_scale,
    with_legend,
)
from toolkit.io.splats import SUFFIXES
from toolkit.io.trajectories import read_tum
from toolkit.rendering import RenderOptions, backend, render_surface
from toolkit.rendering.viewpoints import Viewpoint, overview
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.folder import read_cloud
from toolkit.semantics.palette import Palette

_log = logging.getLogger(__name__)

# Rendered pixels thinner than this show no surface.
_MIN_SILHOUETTE = 0.5
_SEMANTIC = {"labels", "levels"}
_LEGEND_ROWS = 8
# Views drawn beforehand to find the depths that the colours must cover.
_SPAN_VIEWS = 8
# Where nothing says more: about 60 degrees wide, as most RGB-D cameras are.
_DEFAULT_CAMERA = Camera(fx=550.0, fy=550.0, cx=319.5, cy=239.5, width=640, height=480)


@dataclass(frozen=True)
class _Map:
    """What is drawn, and all that the run knows about it."""

    gaussians: GaussianCloud
    run: FinishedRun | None
    backend_name: str
    labels: bool = False


@dataclass(frozen=True)
class _Shot:
    """One view to draw: the number in its file names, and the data set's frame taken there."""

    number: int
    T_map_camera: NDArray[np.float64]
    frame_index: int | None = None


@dataclass(frozen=True)
class _Drawn:
    """Colour [H, W, 3], surface depth [H, W] in metres (0: none), silhouette [H, W], and nodes of
    the class tree [L, H, W] where they were asked for."""

    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    silhouette: NDArray[np.float32]
    nodes: NDArray[np.int32] | None = None


def main(argv: Sequence[str]) -> int:
    """Render views.

    Returns:
        0.

    Raises:
        ToolkitError: the map, trajectory or data set cannot be read, a value is out of
            range, or the folder cannot be written.
    """
    program = parse_arguments(RenderProgram, argv, "render")
    _check_values(program)
    subject = _open(program)
    palette = _palette(subject)
    camera = _camera(program, subject.run)
    inputs = _Inputs.of(program, subject.run, camera)
    shots = _shots(program, subject, camera)[:: program.every]
    out = _prepared_folder(program)

    step = max(1, len(shots) // _SPAN_VIEWS)
    span = DepthSpan.of(_draw(subject, camera, shot).depth_m for shot in shots[::step])
    for shot in tqdm(shots, unit="view", file=sys.stderr, disable=not sys.stderr.isatty()):
        drawn = _draw(subject, camera, shot)
        observed = inputs.rgb(shot) if inputs else None
        pictures: dict[str, Picture] = {
            kind: _picture(kind, drawn, span, observed)
            for kind in program.what
            if kind not in _SEMANTIC
        }
        if palette is not None:
            pictures |= _label_pictures(program.what, palette, drawn)
        for name, picture in pictures.items():
            write_png(out / f"{name}_{shot.number:06d}.png", picture)
    print(f"drew {len(shots)} view(s) into {out}")
    return 0


def _check_values(program: RenderProgram) -> None:
    if program.trajectory is not None and program.view:
        raise SettingsError("give --trajectory or --view, not both")
    if not np.isfinite(np.array(program.view)).all():
        raise SettingsError("--view must be finite numbers")


def _open(program: RenderProgram) -> _Map:
    path, labels = program.map, bool(_SEMANTIC & set(program.what))
    if labels and not path.is_dir():
        raise SettingsError(f"--what labels needs a run folder; {path} is none")
    if path.suffix in SUFFIXES and not path.is_dir():
        return _Map(read_cloud(path), None, "auto")
    if not path.exists():
        raise DatasetError(
            f"{path} does not exist; give a run folder or a {', '.join(SUFFIXES)} file"
        )
    run = load_run(path)
    if labels and run.taxonomy is None:
        raise SettingsError(
            f"{path} was mapped without semantics; run it with --semantics.code.kind"
        )
    return _Map(run.gaussians, run, run.settings.backend, labels)


def _palette(subject: _Map) -> Palette | None:
    if not subject.labels or subject.run is None or subject.run.taxonomy is None:
        return None
    return Palette(subject.run.taxonomy)


@dataclass(frozen=True)
class _Inputs:
    """The recorded images beside which strips show the rendered ones."""

    dataset: Dataset
    grid: ImageGrid | None

    @classmethod
    def of(cls, program: RenderProgram, run: FinishedRun | None, camera: Camera) -> _Inputs | None:
        """Open the dataset of a run, None where strips need none or it is not available."""
        if run is None or program.camera is not None or "strip" not in program.what:
            return None
        try:
            dataset = run.open_dataset()
        except DatasetError as error:
            _log.warning("strips are drawn without the input images: %s", error)
            return None
        resized = camera.size != dataset.camera.size
        return cls(dataset, ImageGrid(dataset.camera, camera.size) if resized else None)

    def rgb(self, shot: _Shot) -> NDArray[np.float32] | None:
        """The image [H, W, 3] recorded at a view, None where there is none."""
        if shot.frame_index is None:
            return None
        rgb = self.dataset[shot.frame_index].rgb
        return self.grid.colour(rgb) if self.grid else rgb


def _camera(program: RenderProgram, run: FinishedRun | None) -> Camera:
    """The camera of the options, by default that of the run."""
    size = program.image_size
    if program.camera is not None:
        fx, fy, cx, cy = program.camera
        size = size or (run.settings.image_size if run else None)
        # Without a size, the principal point is taken for the middle of the image.
        width, height = size or (round(2 * cx + 1), round(2 * cy + 1))
        return Camera(fx, fy, cx, cy, width, height)
    if run is not None:
        return ImageGrid(run.camera, size).camera if size else run.camera
    width, height = size or _DEFAULT_CAMERA.size
    focal = _DEFAULT_CAMERA.fx * width / _DEFAULT_CAMERA.width
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _shots(program: RenderProgram, subject: _Map, camera: Camera) -> list[_Shot]:
    run = subject.run
    if program.trajectory is not None:
        poses = read_tum(program.trajectory).T_world_camera
        return [_Shot(number, T) for number, T in enumerate(poses)]
    if program.view:
        T_map_first = run.tracked[0].T_map_camera if run and run.tracked else np.eye(4)
        return [
            _Shot(number, T_map_first @ _viewpoint(view).T_map_camera)
            for number, view in enumerate(program.view)
        ]
    if run is not None:
        return [_Shot(frame.index, frame.T_map_camera, frame.index) for frame in run.tracked]
    return [_Shot(0, overview(subject.gaussians, camera))]


def _viewpoint(view: tuple[float, float, float, float, float]) -> Viewpoint:
    x, y, z, yaw_deg, pitch_deg = view
    return Viewpoint((x, y, z), math.radians(yaw_deg), math.radians(pitch_deg))


def _prepared_folder(program: RenderProgram) -> Path:
    out = program.out
    if out is None:
        path = program.map
        out = path / "renders" / "views" if path.is_dir() else path.with_name(f"{path.stem}_views")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(out, error) from error
    return out


def _draw(subject: _Map, camera: Camera, shot: _Shot) -> _Drawn:
    drawn = render_surface(
        backend(subject.backend_name),
        subject.gaussians,
        camera,
        se3.inverse(shot.T_map_camera),
        RenderOptions(_MIN_SILHOUETTE, features=subject.labels),
    )
    seen = drawn.output
    nodes = None
    if subject.labels and subject.run is not None:
        nodes = subject.run.semantics.decode_view(drawn).nodes.T.reshape(-1, *drawn.depth_m.shape)
    return _Drawn(seen.colour.numpy(), drawn.depth_m.numpy(), seen.silhouette.numpy(), nodes)


def _label_pictures(what: Sequence[str], palette: Palette, drawn: _Drawn) -> dict[str, Picture]:
    """Pictures of the class tree's levels by the beginning of their file's name."""
    assert drawn.nodes is not None
    pictures = {}
    if "labels" in what:
        for level, nodes in enumerate(drawn.nodes):
            picture = with_legend(palette.picture(nodes), palette.legend(nodes))
            pictures[f"labels_l{level}"] = picture
    if "levels" in what:
        rgb = np.clip(drawn.rgb, 0.0, 1.0)
        strip = palette.level_strip(rgb, list(drawn.nodes), legend_rows=_LEGEND_ROWS)
        pictures["levels"] = strip
    return pictures


def _picture(
    kind: str, drawn: _Drawn, span: DepthSpan, observed: NDArray[np.float32] | None
) -> Picture:
    if kind == "colour":
        return colour_picture(drawn.rgb)
    if kind == "depth":
        return with_depth_scale(depth_picture(drawn.depth_m, span), span)
    if kind == "silhouette":
        return silhouette_picture(drawn.silhouette)
    return view_strip(drawn.rgb, drawn.depth_m, drawn.silhouette, observed, span)
