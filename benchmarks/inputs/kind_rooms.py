"""Recordings as people have them, made on the spot from a small synthetic room."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io import images
from toolkit.io.trajectories import write_tum

Array = NDArray[np.float64]

FRAMES, WIDTH, HEIGHT = 40, 160, 120
_SCALE, _FPS = 5000.0, 30.0
UTM_M = np.array([388096.0, 3948996.0, 57.0])


@dataclass(frozen=True)
class RoomChange:
    """What is done to the room before it is written.

    Attributes:
        pose: from a true pose to the written one.
        depth: from depth in units of the PNG and the frame's index to what is written.
        rgb: from the colour image and the index to what is written.
        scale: of all lengths.
        has_depth: whether depth is written.
    """

    pose: Callable[[Array], Array] = lambda T: T
    depth: Callable[[NDArray, int], NDArray] = lambda depth, _: depth
    rgb: Callable[[NDArray, int], NDArray] = lambda rgb, _: rgb
    scale: float = 1.0
    has_depth: bool = True


def write_room(folder: Path, change: RoomChange) -> None:
    """Write the changed room as a dataset of kind `folder`."""
    frames, truth = tiny_room(FRAMES, WIDTH, HEIGHT)
    (folder / "rgb").mkdir(parents=True)
    for frame in frames:
        name = f"{frame.index:06d}.png"
        images.write_rgb(folder / "rgb" / name, change.rgb(frame.rgb, frame.index))
        if change.has_depth:
            depth = np.rint(frame.depth_m * _SCALE).astype(np.uint16)
            changed = change.depth(depth, frame.index).astype(np.uint16)
            (folder / "depth").mkdir(exist_ok=True)
            images.write_png(folder / "depth" / name, changed)
    camera = frames[0].camera
    names = ("fx", "fy", "cx", "cy", "width", "height")
    values: dict[str, Any] = {name: getattr(camera, name) for name in names}
    values |= {"depth_scale": _SCALE / change.scale, "fps": _FPS}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(values))
    poses = np.array(truth.T_world_camera)
    poses[:, :3, 3] *= change.scale
    times_s = np.arange(FRAMES) / _FPS
    changed_poses = np.array([change.pose(T) for T in poses])
    write_tum(folder / "trajectory.txt", Trajectory(times_s, changed_poses))


@dataclass(frozen=True)
class Kind:
    """A kind of recording.

    Attributes:
        change: of the room.
        right: what is right, for the table.
        after: called with the folder when it is written.
        job: the program and its arguments; FOLDER and OUT are replaced.
        scale: of its lengths, by which errors are divided.
    """

    right: str
    change: RoomChange = field(default_factory=RoomChange)
    after: Callable[[Path], None] = lambda _: None
    job: tuple[str, ...] = ("run", "--dataset.kind", "folder", "--dataset.path", "FOLDER")

    @property
    def scale(self) -> float:
        return self.change.scale


def _every_second(folder: Path) -> None:
    """Images far apart, as photographs for a model of COLMAP."""
    places = range(0, FRAMES, 2)
    for place, file in enumerate(sorted((folder / "rgb").iterdir())):
        if place not in places:
            file.unlink()
    for number, place in enumerate(places):
        (folder / f"rgb/{place:06d}.png").rename(folder / f"rgb/x{number:06d}.png")
    truth = tiny_room(FRAMES, WIDTH, HEIGHT)[1].T_world_camera[list(places)]
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(len(places)) / _FPS, truth))


def _missing_at_random(share: float) -> RoomChange:
    def sparse(depth: NDArray, index: int) -> NDArray:
        kept = np.random.default_rng(index).random(depth.shape) < share
        return np.where(kept, depth, 0)

    return RoomChange(depth=sparse)


def _in_lines(every: int) -> RoomChange:
    def lines(depth: NDArray, index: int) -> NDArray:
        kept = np.zeros(depth.shape, bool)
        kept[(index % every) :: every] = True
        return np.where(kept, depth, 0)

    return RoomChange(depth=lines)


def _moved(T: Array, position: Array) -> Array:
    return se3.from_rotation_translation(T[:3, :3], position)


def _shifted(depth: NDArray, _: int) -> NDArray:
    move = np.array([[1, 0, 8], [0, 1, -4]], np.float32)
    return cv2.warpAffine(depth, move, depth.shape[::-1], flags=cv2.INTER_NEAREST)


def _with_far_value(depth: NDArray, index: int) -> NDArray:
    holes = np.random.default_rng(index).random((HEIGHT // 8, WIDTH // 8)) < 0.15
    return np.where(holes.repeat(8, 0).repeat(8, 1), 65535, depth)


def _with_camera(edit: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Path], None]:
    """States other intrinsics: what `edit` makes of the true ones."""

    def change(folder: Path) -> None:
        file = folder / "intrinsics.yaml"
        values = yaml.safe_load(file.read_text())
        file.write_text(yaml.safe_dump(values | edit(values)))

    return change


def _scaled_camera(**factors: float) -> Callable[[Path], None]:
    return _with_camera(lambda values: {k: f * values[k] for k, f in factors.items()})


def _turned_camera(quarters: int) -> Callable[[Path], None]:
    def turn(values: dict[str, Any]) -> dict[str, Any]:
        for _ in range(quarters):
            turned = {"cx": values["cy"], "cy": values["width"] - 1 - values["cx"]}
            pairs = (("fx", "fy"), ("fy", "fx"), ("width", "height"), ("height", "width"))
            values = values | {new: values[old] for new, old in pairs} | turned
        return values

    return _with_camera(turn)


def _bent(k1: float) -> RoomChange:
    """Images of a lens with radial distortion that is not stated."""
    focal = tiny_room(1, WIDTH, HEIGHT)[0][0].camera.focal
    centre = np.array([WIDTH - 1, HEIGHT - 1]) / 2.0
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1)
    bent = (grid - centre) / focal
    seen = bent
    for _ in range(10):
        seen = bent / (1.0 + k1 * (seen**2).sum(axis=-1, keepdims=True))
    axes = np.moveaxis((focal * seen + centre).astype(np.float32), 2, 0)

    def warped(image: NDArray, kind: int) -> NDArray:
        return np.asarray(cv2.remap(image, *axes, kind, borderMode=cv2.BORDER_REPLICATE))

    return RoomChange(
        depth=lambda depth, _: warped(depth, cv2.INTER_NEAREST),
        rgb=lambda rgb, _: warped(rgb, cv2.INTER_LINEAR),
    )


def _with_a_jump(folder: Path) -> None:
    poses = np.array(tiny_room(FRAMES, WIDTH, HEIGHT)[1].T_world_camera)
    poses[FRAMES // 2 :, 0, 3] += 0.1
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(FRAMES) / _FPS, poses))


def _with_inverse_priors(folder: Path) -> None:
    """Write depth priors of inverse depth."""
    (folder / "priors").mkdir()
    for frame in tiny_room(FRAMES, WIDTH, HEIGHT)[0]:
        inverse = 1.0 / np.maximum(frame.depth_m, 0.1)
        np.save(folder / "priors" / f"{frame.index:06d}.npy", inverse.astype(np.float32))


def _turned(quarters: int) -> RoomChange:
    """Images of a camera that is turned, as those of a phone in portrait."""
    R = np.linalg.matrix_power(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), quarters
    )
    turn = se3.from_rotation_translation(R, np.zeros(3))
    return RoomChange(
        pose=lambda T: T @ turn,
        depth=lambda depth, _: np.ascontiguousarray(np.rot90(depth, quarters)),
        rgb=lambda rgb, _: np.ascontiguousarray(np.rot90(rgb, quarters)),
    )


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_UNITY = np.diag([1.0, -1.0, 1.0, 1.0])
_RUN = Kind.job
_GIVEN = (*_RUN, "--poses", "given")
_PRIORS = (
    *(*_RUN, "--depth", "none", "--depth-prior.use", "correct", "--depth-prior.kind", "maps"),
    *("--depth-prior.maps.folder", "FOLDER/priors", "--depth-prior.maps.values"),
)

_POSES = {
    "OpenGL": ("stops, names the axes", lambda T: T @ OPENGL),
    "from world to camera": ("stops, names the inverse", se3.inverse),
    "left-handed": ("stops, names it", lambda T: _UNITY @ T @ _UNITY),
    "in millimetres": ("stops, names the unit", lambda T: _moved(T, 1e3 * T[:3, 3])),
    "in UTM": ("a good map", lambda T: _moved(T, T[:3, 3] + UTM_M)),
}
_SAME = RoomChange()
_BLIND = RoomChange(has_depth=False)
_LONG, _REFINED = _scaled_camera(fx=1.2, fy=1.2), (*_RUN, "--dataset.intrinsics", "refine")
_BLACK = RoomChange(
    rgb=lambda rgb, i: rgb * (i >= 4), depth=lambda depth, i: depth * np.uint16(i >= 4)
)
_UP = "a good map, names the side that is up"
KINDS: Mapping[str, Kind] = {
    "as it is": Kind("a good map"),
    "65535 where nothing was measured": Kind(
        "the map of the rest", RoomChange(depth=_with_far_value)
    ),
    **{
        f"given poses {name}": Kind(right, RoomChange(pose=pose), job=_GIVEN)
        for name, (right, pose) in _POSES.items()
    },
    "colour shifted by (-8, +4) px": Kind("the run reports it", RoomChange(depth=_shifted)),
    "focal length 20 % too long": Kind("names the right one", _SAME, _LONG),
    "focal length 20 % too long, refined": Kind("a good map", _SAME, _LONG, _REFINED),
    "principal point off by 12 px": Kind("names the right one", _SAME, _scaled_camera(cx=1.15)),
    "distortion k1 = -0.2, not stated": Kind("names it", _bent(-0.2)),
    "unit of depth off by 25 %": Kind("names the factor", RoomChange(depth=lambda d, _: 1.25 * d)),
    "given poses jump by 10 cm": Kind("names the frame", _SAME, _with_a_jump, _GIVEN),
    "camera in portrait": Kind(_UP, _turned(1), _turned_camera(1)),
    "camera upside down": Kind(_UP, _turned(2), _turned_camera(2)),
    "a scene at 6 cm": Kind("a good map", RoomChange(scale=1 / 25)),
    "a scene at 90 m": Kind("a good map", RoomChange(scale=60.0)),
    "four black frames at the start": Kind("a good map of the rest", _BLACK),
    "half of the depth missing at random": Kind("a good map", _missing_at_random(0.5)),
    "5 % of the depth": Kind("a good map", _missing_at_random(0.05)),
    "depth in every 8th row": Kind("a good map", _in_lines(8)),
    "given poses, no depth": Kind(
        "a good map", _BLIND, _every_second, (*_GIVEN, "--depth", "none")
    ),
    "inverse depth priors, declared as metric": Kind(
        "names the kind", _BLIND, _with_inverse_priors, (*_PRIORS, "metric")
    ),
    "inverse depth priors, declared as that": Kind(
        "a good map", _BLIND, _with_inverse_priors, (*_PRIORS, "affine-inverse")
    ),
}
