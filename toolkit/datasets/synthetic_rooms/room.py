"""Creation of synthetic rooms as a dataset folder or as frames in memory."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.synthetic_rooms import collection, writer
from toolkit.datasets.synthetic_rooms.finishes import LACQUER_REFLECTANCE
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, TEXTURES, Layout, Look, build_scene
from toolkit.datasets.synthetic_rooms.paths import hand_held_path
from toolkit.datasets.synthetic_rooms.ray_casting import RayCastView, Scene
from toolkit.datasets.synthetic_rooms.reflections import measured_depth
from toolkit.datasets.synthetic_rooms.sensor import Sensor, SensorModel
from toolkit.datasets.synthetic_rooms.unseen import poses_off_the_path
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES, GLOSSY_CLASS_NAMES, numbered
from toolkit.datasets.synthetic_rooms.walker import Walker

RATE_HZ = 30.0
# Focal length per image width: a horizontal field of view of 64 degrees.
_FOCAL = 0.8
# Number of frames of the default room at walking pace; other layouts compute it from the path.
_ROOM_FRAMES = 300
# Identifiers of random streams; 1 is used for furniture.
_SWAY, _SENSOR, _UNSEEN, _WALKER = 2, 3, 4, 5

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RoomSettings:
    """Settings of a synthetic room.

    Attributes:
        layout: "room", "rooms" (three and a corridor), "hall" (twelve), "ring" (four that
            close a loop), "ring-moved", "ring-light", "ring-evening", "ring-repainted" and
            "ring-changed" (the first room differs when the camera returns: `Revisit`), "twins"
            (two of three rooms are identical), "twins-objects" (they contain different objects),
            "orbit" (around objects on a table), "still" (one room from one place), "long"
            (freely through one room, for minutes), "corridor" (along white panels with identical
            doors to a hall, and back), "corridor-turns" (the camera also turns to the sides),
            "corridor-stop" (it stands still for 20 frames) or "wall" (along a wall of an empty
            room).
        seed: random seed of furniture, textures, camera sway and noise, >= 0.
        frames: number of frames, distributed over the path; None for walking pace (300 for the
            default room, about 2000 for the others).
        share: fraction of the path to use, in (0, 1].
        width, height: image size in pixels, at least 16.
        sensor: simulated effects of a real camera, or None for ideal images.
        unseen: number of test views off the path, which are always ideal and without a walker.
        walker: whether a person walks through the view for a part of the sequence.
        texture: "normal"; "weak": all surfaces are nearly uniform; "plain": walls, ceilings,
            floors and doors are uniform; "wallpaper" or "stripes": that of all walls, which repeats
            every 12.5 cm.
        fov_deg: horizontal field of view in degrees, from 10 to 120; None for that of common
            RGB-D cameras, 64.
        classes: number of classes of a room whose walls are covered with shelves of small objects,
            from 20 to 500; only with the layout "room" and without reflections. None for a
            furnished room with the classes of Replica.
        glossy: floors are lacquered, screens are off, and the largest picture of each room and the
            doors of its wardrobe are mirrors; neither with a walker nor with classes.
        polish: reflectance of the lacquered floors seen from above, in (0, 1).
    """

    layout: str = "room"
    seed: int = 0
    frames: int | None = None
    share: float = 1.0
    width: int = 320
    height: int = 240
    sensor: SensorModel | None = field(default=None)
    unseen: int = 20
    walker: bool = False
    texture: str = "normal"
    fov_deg: float | None = None
    classes: int | None = None
    glossy: bool = False
    polish: float = LACQUER_REFLECTANCE

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
        if self.texture not in TEXTURES:
            raise SettingsError(
                f"texture must be one of {', '.join(TEXTURES)}, got {self.texture!r}"
            )
        if self.fov_deg is not None and not 10.0 <= self.fov_deg <= 120.0:
            raise SettingsError(f"fov_deg must lie in [10, 120], got {self.fov_deg}")
        if self.classes is not None:
            self._check_classes(self.classes)
        if not 0.0 < self.polish < 1.0:
            raise SettingsError(f"polish must lie in (0, 1), got {self.polish}")
        if self.glossy:
            self._check_glossy()
        elif self.polish != LACQUER_REFLECTANCE:
            raise SettingsError("polish requires glossy")

    def _check_classes(self, classes: int) -> None:
        low, high = collection.MIN_CLASSES, collection.MAX_CLASSES
        if not low <= classes <= high:
            raise SettingsError(f"classes must lie in [{low}, {high}], got {classes}")
        if self.layout != "room":
            raise SettingsError(f"classes requires the layout 'room', got {self.layout!r}")
        if self.sensor is not None and self.sensor.reflections:
            raise SettingsError("classes cannot be combined with real: no object is shiny")

    def _check_glossy(self) -> None:
        if self.walker:
            raise SettingsError("glossy cannot be combined with walker or real: no mirror shows it")
        if self.classes is not None:
            raise SettingsError("glossy cannot be combined with classes: the room has no mirror")

    @property
    def camera(self) -> Camera:
        """Camera with the horizontal field of view of the settings."""
        focal = _FOCAL * self.width
        if self.fov_deg is not None:
            focal = 0.5 * self.width / math.tan(0.5 * math.radians(self.fov_deg))
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera(focal, focal, *centre, self.width, self.height)

    @property
    def collection(self) -> tuple[str, ...] | None:
        """Class names of a room with shelves of objects; None for a furnished room."""
        return None if self.classes is None else collection.class_names(self.classes)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of all classes of the room, in the order of their ids, which start at 1."""
        if self.collection is not None:
            return self.collection
        return GLOSSY_CLASS_NAMES if self.glossy else CLASS_NAMES

    def as_written(self) -> dict[str, Any]:
        """Values for the room's file of settings; those of rooms without gloss do not name it."""
        values = asdict(self)
        if not self.glossy:
            del values["glossy"], values["polish"]
        return values

    def stream(self, purpose: int) -> np.random.Generator:
        """Return the random generator of one purpose, independent of the others."""
        return np.random.default_rng([self.seed, purpose])


def make_room(
    path: Path | str,
    settings: RoomSettings | None = None,
    progress: Callable[[Iterable[Frame], int], Iterable[Frame]] | None = None,
) -> None:
    """Write a room in Replica's layout, with labels, mesh and unseen views.

    Args:
        path: a new or empty folder, or the folder of an existing synthetic room.
        settings: settings of the room; by default those of the default room.
        progress: wraps the iterable of frames, given their number, to show progress.

    Raises:
        DatasetError: the folder contains other files or cannot be written.
        DependencyError: Open3D cannot be loaded.
    """
    settings = settings or RoomSettings()
    path = Path(path)
    camera = settings.camera  # raises before a folder is made if the images are too large
    writer.prepare_folder(path)
    layout = LAYOUTS[settings.layout]()
    scene = room_scene(settings)
    class_ids = numbered(settings.class_names)
    poses = _poses(layout, settings)
    _log.info("%s: %d frames, %d triangles", path, len(poses), len(scene.triangles))
    later = scene
    if layout.revisit:
        later = room_scene(settings, later=True)
    views = writer.with_instances(path, _views(scene, settings, poses, later))
    if settings.walker:
        views = writer.with_walker_masks(path, views)
    if settings.glossy:
        views = writer.with_surfaces(path, views)
    frames: Iterable[Frame] = _frames(views, camera)
    if progress is not None:
        frames = progress(frames, len(poses))
    writer.write_sequence(path, frames, camera, poses, class_ids)
    ideal = poses_off_the_path(scene, camera, poses, settings.unseen, settings.stream(_UNSEEN))
    unseen: Iterable[RayCastView] = (scene.render(camera, T) for T in ideal)
    unseen = writer.with_instances(path / "unseen", unseen)
    if settings.glossy:
        unseen = writer.with_surfaces(path / "unseen", unseen)
    writer.write_sequence(path / "unseen", _frames(unseen, camera), camera, ideal, class_ids)
    writer.write_mesh(path / "mesh.ply", scene)
    writer.write_json(path / writer.MARKER, settings.as_written())


def room_scene(settings: RoomSettings, later: bool = False) -> Scene:
    """Build the scene of a room, which can be rendered from any camera.

    Args:
        settings: settings of the room; the size of its images sets the resolution of textures.
        later: return the scene of the second half of the path.
    """
    look = Look(settings.texture, settings.glossy, settings.polish)
    layout, texel_m = LAYOUTS[settings.layout](), _texel_m(settings)
    return build_scene(layout, settings.seed, texel_m, look, settings.collection, later=later)


def tiny_room(
    frames: int = 10,
    width: int = 80,
    height: int = 60,
    seed: int = 0,
    sensor: SensorModel | None = None,
) -> tuple[list[Frame], Trajectory]:
    """Create the first frames of the default room in memory, at walking pace.

    Returns:
        The frames, and the true poses at their timestamps.
    """
    share = min(1.0, frames / _ROOM_FRAMES)
    settings = RoomSettings("room", seed, frames, share, width, height, sensor)
    layout = LAYOUTS[settings.layout]()
    poses = _poses(layout, settings)
    scene = _shared_scene(settings.layout, seed, _texel_m(settings))
    made = list(_frames(_views(scene, settings, poses, scene), settings.camera))
    return made, Trajectory(np.arange(frames) / RATE_HZ, poses)


def _texel_m(settings: RoomSettings) -> float:
    """Return a texel size of about one pixel at a distance of one metre.

    It does not depend on the field of view: the atlas of a narrow one would be too large.
    """
    return max(1.0 / (_FOCAL * settings.width), 0.0015)


@functools.lru_cache(maxsize=8)
def _shared_scene(layout_name: str, seed: int, texel_m: float) -> Scene:
    """Build the scene of a tiny room; cached, because scenes are small and often reused."""
    return build_scene(LAYOUTS[layout_name](), seed, texel_m)


def _poses(layout: Layout, settings: RoomSettings) -> NDArray[np.float64]:
    frames = settings.frames
    if frames is None and settings.layout == "room":
        frames = max(2, round(settings.share * _ROOM_FRAMES))
    sway = settings.stream(_SWAY)
    return hand_held_path(layout.way_points, frames, settings.share, sway, layout.gait)


def _views(
    scene: Scene, settings: RoomSettings, poses: NDArray, later: Scene
) -> Iterator[RayCastView]:
    """Yield what the camera sees along the path; `later` is the scene of its second half."""
    camera, sensor, walker = settings.camera, None, None
    if settings.walker:
        walker = Walker(scene, poses, _texel_m(settings), settings.stream(_WALKER))
    if settings.sensor is not None:
        sensor = Sensor(settings.sensor, camera, poses, settings.stream(_SENSOR))
    for index, T_world_camera in enumerate(poses):
        shown = scene if 2 * index < len(poses) else later
        view = shown.render(camera, T_world_camera)
        if walker is not None:
            view = walker.add_to(index, view, camera, T_world_camera)
        if view.reflection is not None:
            view = replace(view, depth_m=measured_depth(view.reflection, view.cosine))
        yield view if sensor is None else sensor.observe(index, view)


def _frames(views: Iterable[RayCastView], camera: Camera) -> Iterator[Frame]:
    for index, view in enumerate(views):
        yield Frame(index, index / RATE_HZ, view.rgb, view.depth_m, camera, view.labels)
