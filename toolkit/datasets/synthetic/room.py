"""Synthetic rooms: settings in, a folder or frames in memory out."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic import writer
from toolkit.datasets.synthetic.layouts import LAYOUTS, Layout, build_scene
from toolkit.datasets.synthetic.paths import hand_held_path
from toolkit.datasets.synthetic.ray_casting import Scene
from toolkit.datasets.synthetic.sensor import Sensor, SensorModel
from toolkit.datasets.synthetic.unseen import poses_off_the_path
from toolkit.errors import SettingsError
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera
from toolkit.geometry.trajectory import Trajectory

RATE_HZ = 30.0
# The default room's way at a person's pace; other layouts count theirs from the way.
_ROOM_FRAMES = 300
# Streams of randomness beside the furniture's, which is 1.
_SWAY, _SENSOR, _UNSEEN = 2, 3, 4

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RoomSettings:
    """What to make.

    Attributes:
        layout: "room", "rooms" (three and a corridor), "hall" (twelve), "ring" (four that
            close a loop) or "twins" (two of three rooms are identical).
        seed: decides furniture, textures, sway of the camera and noise; at least 0.
        frames: how many, spread over the walk; None: a person's pace (300 for the default room,
            about 2000 for the others).
        share: part of the way that is walked, in (0, 1].
        width, height: image size in pixels, at least 16.
        sensor: effects of a real camera, or None for ideal images.
        unseen: number of views off the path; they are always ideal.
    """

    layout: str = "room"
    seed: int = 0
    frames: int | None = None
    share: float = 1.0
    width: int = 320
    height: int = 240
    sensor: SensorModel | None = field(default=None)
    unseen: int = 20

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise SettingsError(f"layout must be one of {', '.join(LAYOUTS)}, got {self.layout!r}")
        if not 0.0 < self.share <= 1.0:
            raise SettingsError(f"share must lie in (0, 1], got {self.share}")
        if self.frames is not None and self.frames < 1:
            raise SettingsError(f"frames must be at least 1, got {self.frames}")
        if min(self.width, self.height) < 16:
            raise SettingsError(
                f"image size must be at least 16x16, got {self.width}x{self.height}"
            )
        if self.seed < 0 or self.unseen < 0:
            raise SettingsError("seed and unseen must not be negative")

    @property
    def camera(self) -> Camera:
        """64 degrees wide, as many RGB-D cameras are."""
        focal = 0.8 * self.width
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera(focal, focal, *centre, self.width, self.height)

    def stream(self, purpose: int) -> np.random.Generator:
        """Randomness for one purpose, independent of the others."""
        return np.random.default_rng([self.seed, purpose])


def make_room(
    path: Path | str,
    settings: RoomSettings | None = None,
    progress: Callable[[Iterable[Frame], int], Iterable[Frame]] | None = None,
) -> None:
    """Write a room in Replica's layout, with labels, mesh and unseen views.

    Args:
        path: a new or empty folder, or one that holds an earlier synthetic room.
        settings: what to make; the default room without them.
        progress: wraps the frames, given their number, as they are made.

    Raises:
        DatasetError: the folder holds something else or cannot be written.
        DependencyError: Open3D cannot be loaded.
    """
    settings = settings or RoomSettings()
    path = Path(path)
    camera = settings.camera  # raises before a folder is made if the images are too large
    writer.prepare_folder(path)
    layout = LAYOUTS[settings.layout]()
    scene = build_scene(layout, settings.seed, _texel_m(settings))
    poses = _poses(layout, settings)
    _log.info("%s: %d frames, %d triangles", path, len(poses), len(scene.triangles))
    frames: Iterable[Frame] = _frames(scene, settings, poses)
    if progress is not None:
        frames = progress(frames, len(poses))
    writer.write_sequence(path, frames, camera, poses)
    ideal = poses_off_the_path(scene, camera, poses, settings.unseen, settings.stream(_UNSEEN))
    writer.write_sequence(path / "unseen", _ideal_frames(scene, camera, ideal), camera, ideal)
    writer.write_mesh(path / "mesh.ply", scene)
    writer.write_json(path / writer.MARKER, asdict(settings))


def tiny_room(
    frames: int = 10,
    width: int = 80,
    height: int = 60,
    seed: int = 0,
    sensor: SensorModel | None = None,
) -> tuple[list[Frame], Trajectory]:
    """The first steps in the default room, in memory, at a person's pace.

    Returns:
        the frames, and the true poses at the frames' times.
    """
    share = min(1.0, frames / _ROOM_FRAMES)
    settings = RoomSettings("room", seed, frames, share, width, height, sensor)
    layout = LAYOUTS[settings.layout]()
    poses = _poses(layout, settings)
    scene = _shared_scene(settings.layout, seed, _texel_m(settings))
    made = list(_frames(scene, settings, poses))
    return made, Trajectory(np.arange(frames) / RATE_HZ, poses)


def _texel_m(settings: RoomSettings) -> float:
    """About one texel a pixel at one metre: finer detail would only alias."""
    return max(1.0 / settings.camera.focal, 0.0015)


@functools.lru_cache(maxsize=2)
def _shared_scene(layout_name: str, seed: int, texel_m: float) -> Scene:
    """Scenes of tiny rooms are small and asked for often."""
    return build_scene(LAYOUTS[layout_name](), seed, texel_m)


def _poses(layout: Layout, settings: RoomSettings) -> NDArray[np.float64]:
    frames = settings.frames
    if frames is None and settings.layout == "room":
        frames = max(2, round(settings.share * _ROOM_FRAMES))
    return hand_held_path(layout.way, frames, settings.share, settings.stream(_SWAY))


def _frames(scene: Scene, settings: RoomSettings, poses: NDArray) -> Iterator[Frame]:
    """What the camera delivers along the path."""
    camera = settings.camera
    if settings.sensor is None:
        yield from _ideal_frames(scene, camera, poses)
        return
    sensor = Sensor(settings.sensor, camera, poses, settings.stream(_SENSOR))
    for index, T_world_camera in enumerate(poses):
        view = sensor.observe(index, scene.render(camera, T_world_camera))
        yield Frame(index, index / RATE_HZ, view.rgb, view.depth_m, camera, view.labels)


def _ideal_frames(scene: Scene, camera: Camera, poses: NDArray) -> Iterator[Frame]:
    for index, T_world_camera in enumerate(poses):
        view = scene.render(camera, T_world_camera)
        yield Frame(index, index / RATE_HZ, view.rgb, view.depth_m, camera, view.labels)
