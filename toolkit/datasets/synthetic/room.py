"""Synthetic rooms: settings in, a folder or frames in memory out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic import layouts, writer
from toolkit.datasets.synthetic.paths import hand_held_path
from toolkit.datasets.synthetic.ray_casting import Scene
from toolkit.errors import SettingsError
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera
from toolkit.geometry.trajectory import Trajectory

RATE_HZ = 30.0


@dataclass(frozen=True)
class RoomSettings:
    """What to make.

    Attributes:
        layout: one of `layouts.LAYOUTS`.
        seed: decides furniture, textures, sway of the camera and noise.
        frames: how many, spread over the walk; None: a person's pace (300 for "room").
        share: part of the way that is walked, in (0, 1].
        width, height: image size in pixels.
    """

    layout: str = "room"
    seed: int = 0
    frames: int | None = None
    share: float = 1.0
    width: int = 320
    height: int = 240

    def __post_init__(self) -> None:
        if self.layout not in layouts.LAYOUTS:
            raise SettingsError(f"layout must be one of {', '.join(layouts.LAYOUTS)}")

    @property
    def camera(self) -> Camera:
        """64 degrees wide, as many RGB-D cameras."""
        focal = 0.8 * self.width
        return Camera(
            focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, self.width, self.height
        )


def make_room(path: Path | str, settings: RoomSettings) -> None:
    """Write a room in Replica's layout."""
    path = Path(path)
    writer.prepare_folder(path)
    layout = layouts.LAYOUTS[settings.layout]()
    scene = _scene(layout, settings)
    T_world_camera = _poses(layout, settings)
    writer.write_sequence(path, _frames(scene, settings, T_world_camera), settings.camera, T_world_camera)
    writer.write_mesh(path / "mesh.ply", scene)
    writer._write_json(path / writer.MARKER, asdict(settings))


def _scene(layout: layouts.Layout, settings: RoomSettings) -> Scene:
    # About one texel a pixel at one metre: finer detail would only alias.
    texel_m = max(1.0 / settings.camera.focal, 0.0015)
    parts = layouts.build_parts(layout, settings.seed)
    return Scene(parts, layouts.lamp_places(layout), texel_m)


def _poses(layout: layouts.Layout, settings: RoomSettings) -> NDArray[np.float64]:
    frames = settings.frames or layout.frames
    rng = np.random.default_rng([settings.seed, 1])
    return hand_held_path(list(layout.way), frames, settings.share, rng)


def _frames(scene: Scene, settings: RoomSettings, T_world_camera: NDArray) -> Iterator[Frame]:
    for index, T in enumerate(T_world_camera):
        view = scene.render(settings.camera, T)
        yield Frame(index, index / RATE_HZ, view.rgb, view.depth_m, settings.camera, view.labels)


def tiny_room(frames: int = 10, width: int = 80, height: int = 60) -> tuple[list[Frame], Trajectory]:
    """The first steps in the default room, in memory."""
    settings = RoomSettings(frames=frames, share=frames / 300, width=width, height=height)
    layout = layouts.LAYOUTS[settings.layout]()
    T_world_camera = _poses(layout, settings)
    made = list(_frames(_scene(layout, settings), settings, T_world_camera))
    return made, Trajectory(np.arange(frames) / RATE_HZ, T_world_camera)
