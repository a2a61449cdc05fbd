"""The data of the benchmarks: real recordings and synthetic rooms."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from benchmarks.shared.programs import semsplat
from benchmarks.shared.runner import WORK
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset

# Options of `semsplat make-room` for each synthetic sequence; a number behind the name is its seed.
_NOISE = ("--sensor-noise",)
_RING = ("--layout", "ring", "--frames", "900")
_SMALL = ("--image-size", "160", "120", "--sensor-noise")
_CORRIDOR = ("--glossy", "--frames", "600", *_NOISE)
_WALL = ("--frames", "300", *_NOISE)
_TINY = ("--image-size", "120", "90", "--sensor-noise")
_SHORT = ("--frames", "60", "--unseen", "0", "--image-size", "160", "120")
# Parts of rooms for checks of recordings.
SHORT_ROOMS: dict[str, tuple[str, ...]] = {
    "short-room": (*_SHORT, "--share", "0.2"),
    "short-room-noise": (*_SHORT, "--share", "0.2", *_NOISE),
    "short-room-real": (*_SHORT, "--share", "0.3", "--real"),
    "short-room-glossy": (*_SHORT, "--share", "0.3", "--glossy"),
    "short-room-walker": (*_SHORT, "--share", "0.3", "--walker"),
    "short-room-weak": (*_SHORT, "--share", "0.2", "--texture", "weak", *_NOISE),
    "short-room-narrow": (*_SHORT, "--share", "0.2", "--fov-deg", "30", *_NOISE),
    "short-room-wide": (*_SHORT, "--share", "0.2", "--fov-deg", "100", *_NOISE),
    "short-room-large": ("--frames", "60", "--image-size", "640", "480", "--share", "0.2", *_NOISE),
    "short-collection": (*_SHORT, "--share", "0.6", "--classes", "300"),
    "short-rooms": (*_SHORT, "--layout", "rooms", "--share", "0.035", *_NOISE),
    "short-hall": (*_SHORT, "--layout", "hall", "--share", "0.007", *_NOISE),
    "short-ring": (*_SHORT, "--layout", "ring", "--share", "0.06", "--glossy", *_NOISE),
    "short-twins": (*_SHORT, "--layout", "twins", "--share", "0.05", "--real"),
    "short-orbit": (*_SHORT, "--layout", "orbit", "--share", "0.15", *_NOISE),
    "short-still": (*_SHORT, "--layout", "still", "--share", "0.3", *_NOISE),
    "short-long": (*_SHORT, "--layout", "long", "--share", "0.01", *_NOISE),
    "short-corridor": (*_SHORT, "--layout", "corridor", "--share", "0.03", "--glossy", *_NOISE),
    "short-wallpaper": (*_SHORT, "--layout", "wall", "--share", "0.2", "--texture", "wallpaper"),
    "short-stripes": (*_SHORT, "--layout", "wall", "--share", "0.2", "--texture", "stripes"),
}
ROOMS: dict[str, tuple[str, ...]] = {
    **SHORT_ROOMS,
    "room": (),
    "room-noise": ("--sensor-noise",),
    "room-objects": ("--frames", "120", *_NOISE),
    "room-instances": ("--frames", "90", *_SMALL),
    "room-small": ("--frames", "200", *_SMALL),
    "room-weak": ("--texture", "weak"),
    "room-plain": ("--texture", "plain", "--frames", "200", *_NOISE),
    "room-narrow": ("--fov-deg", "30"),
    "ring": (*_RING, "--sensor-noise"),
    "ring-ideal": _RING,
    "ring-small": ("--layout", "ring", "--frames", "450", *_SMALL),
    # A walk slow enough for first-order trackers: 1.5 cm and up to 2 degrees per frame.
    "ring-slow": ("--layout", "ring", "--frames", "1800", *_TINY),
    "ring-moved": ("--layout", "ring-moved", "--frames", "450", *_SMALL),
    "ring-light": ("--layout", "ring-light", "--frames", "450", *_SMALL),
    "ring-evening": ("--layout", "ring-evening", "--frames", "450", *_SMALL),
    "ring-repainted": ("--layout", "ring-repainted", "--frames", "450", *_SMALL),
    "ring-changed": ("--layout", "ring-changed", "--frames", "450", *_SMALL),
    "twins-objects": ("--layout", "twins-objects", "--frames", "450", *_SMALL),
    "twins": ("--layout", "twins", "--frames", "1100", "--sensor-noise"),
    "twins-small": ("--layout", "twins", "--frames", "450", *_SMALL),
    "orbit": ("--layout", "orbit", "--frames", "300", "--sensor-noise"),
    # A film of objects with a telephone, 720x1280, at the size to which a run reduces it.
    "phone": ("--layout", "orbit", "--frames", "706", "--image-size", "360", "640", *_NOISE),
    # Walks through three rooms, at 5 and at 10 cm per frame; turns of 4 and 8 degrees per frame.
    "walk": ("--layout", "rooms", "--frames", "600", *_NOISE),
    "walk-fast": ("--layout", "rooms", "--frames", "300", *_NOISE),
    "still": ("--layout", "still", "--frames", "200", "--sensor-noise"),
    # A fast walk: up to 10 cm and 9 degrees per frame.
    "hall-fast": ("--layout", "hall", "--frames", "1500", *_TINY),
    # Shelves of small objects of 300 classes.
    "collection": ("--classes", "300", "--frames", "100", "--image-size", "160", "120"),
    "hall-short": ("--layout", "hall", "--frames", "800", *_TINY),
    # Views that do not determine the camera's motion; 6 and 3 cm per frame.
    "corridor": ("--layout", "corridor", *_CORRIDOR),
    "corridor-turns": ("--layout", "corridor-turns", *_CORRIDOR),
    "corridor-stop": ("--layout", "corridor-stop", *_CORRIDOR),
    "wallpaper": ("--layout", "wall", "--texture", "wallpaper", *_WALL),
    "stripes": ("--layout", "wall", "--texture", "stripes", *_WALL),
}


@dataclass(frozen=True)
class Recording:
    """A sequence as `semsplat run` takes it.

    Attributes:
        kind: of the dataset.
        folder: its folder below SEMSPLAT_DATA.
        image_size: width and height in pixels; native if None.
    """

    kind: str
    folder: str
    image_size: tuple[int, int] | None = None

    @property
    def path(self) -> Path:
        """Its folder.

        Raises:
            SystemExit: SEMSPLAT_DATA is not set or lacks it.
        """
        if "SEMSPLAT_DATA" not in os.environ:
            raise SystemExit("set SEMSPLAT_DATA to the folder of the recordings")
        path = Path(os.environ["SEMSPLAT_DATA"]) / self.folder
        if not path.is_dir():
            raise SystemExit(f"{path} does not exist; SEMSPLAT_DATA must hold {self.folder}")
        return path


RECORDINGS = {
    "redkitchen": Recording("seven-scenes", "7scenes_redkitchen", (320, 240)),
    "redkitchen-native": Recording("seven-scenes", "7scenes_redkitchen"),
    "redkitchen_30fps": Recording("seven-scenes", "7scenes_redkitchen_30fps", (320, 240)),
    "fr1_rpy": Recording("tum", "tum_fr1_rpy", (320, 240)),
    "office0": Recording("replica", "replica_office0"),
    "hololens": Recording("folder", "hololens_walk"),
    "hololens-small": Recording("folder", "hololens_walk", (270, 180)),
    "tartanair-corridor": Recording("folder", "corridor"),
    "euroc": Recording("folder", "euroc_v101"),
}
# The file of true poses has the rotations from the world to the camera.
INVERTED_ROTATIONS = ("euroc",)


def sequence_arguments(name: str, seed: int = 0) -> list[str]:
    """Command-line arguments of `semsplat run` for a recording or a synthetic sequence.

    Args:
        name: a key of RECORDINGS or of ROOMS.
        seed: of the room.
    """
    if name in RECORDINGS:
        recording = RECORDINGS[name]
        size = recording.image_size
        resize = [] if size is None else ["--image-size", *map(str, size)]
        return [*_dataset_arguments(recording.kind, recording.path), *resize]
    return _dataset_arguments("synthetic", room(name, seed))


def opened(name: str, seed: int = 0) -> RecordedDataset:
    """The images of a recording or of a synthetic sequence, for methods that need no depth.

    Args:
        name: a key of RECORDINGS or of ROOMS.
        seed: of the room.
    """
    recording = RECORDINGS.get(name)
    if recording is None:
        return open_dataset("synthetic", room(name, seed))
    return open_dataset(recording.kind, recording.path, recording.image_size, needs_depth=False)


def room(name: str, seed: int = 0) -> Path:
    """The folder of a synthetic sequence, which is rendered when it is first needed.

    Args:
        name: a key of ROOMS.
        seed: of furniture, textures, the camera's sway and the sensor noise.
    """
    folder = WORK / "rooms" / f"{name}-{seed}"
    # Rooms that an earlier version rendered lack instances.
    if not (folder / "instances").is_dir():
        shutil.rmtree(folder, ignore_errors=True)
        partial = folder.with_name(f"{folder.name}.partial")
        print(f"rendering {folder.name}", flush=True)
        semsplat("make-room", "--out", str(partial), *ROOMS[name], "--seed", str(seed))
        partial.rename(folder)
    return folder


def _dataset_arguments(kind: str, path: Path) -> list[str]:
    return ["--dataset.kind", kind, "--dataset.path", str(path)]
