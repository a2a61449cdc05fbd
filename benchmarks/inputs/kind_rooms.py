"""Recordings as people have them, made on the spot from a small synthetic room."""

from __future__ import annotations

import json
import shutil
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


def _with_times_in_nanoseconds(folder: Path) -> None:
    lines = [f"{i:06d} {int(1e18 + i * 1e9 / _FPS)}" for i in range(FRAMES)]
    (folder / "timestamps.txt").write_text("\n".join(lines))
    (folder / "trajectory.txt").unlink()


def _with_files_of_macos(folder: Path) -> None:
    for name in ("rgb", "depth"):
        for file in sorted((folder / name).iterdir()):
            (folder / name / f"._{file.name}").write_bytes(b"\0\5\x16\7")
    (folder / "rgb" / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")


def _with_byte_order_marks(folder: Path) -> None:
    for name in ("trajectory.txt", "intrinsics.yaml"):
        file = folder / name
        text = file.read_text().replace("\n", "\r\n")
        file.write_bytes(b"\xef\xbb\xbf" + text.encode())


def _as_tum_with_own_camera(folder: Path) -> None:
    for kind in ("rgb", "depth"):
        lines = []
        for file in sorted((folder / kind).iterdir()):
            lines.append(f"{int(file.stem) / _FPS + 100.0:.6f} {kind}/{file.name}")
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    (folder / "trajectory.txt").unlink()


def _as_blender(folder: Path) -> None:
    poses = tiny_room(FRAMES, WIDTH, HEIGHT)[1].T_world_camera
    values = yaml.safe_load((folder / "intrinsics.yaml").read_text())
    angle = 2.0 * np.arctan(0.5 * values["width"] / values["fx"])
    frames = [
        {"file_path": f"./rgb/{i:06d}", "transform_matrix": (T @ OPENGL).tolist()}
        for i, T in enumerate(poses)
    ]
    content = {"camera_angle_x": float(angle), "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    (folder / "intrinsics.yaml").unlink()
    (folder / "trajectory.txt").unlink()


def _every_third(folder: Path) -> None:
    """Images far apart, as photographs for a model of COLMAP."""
    poses = []
    for place, file in enumerate(sorted((folder / "rgb").iterdir())):
        if place % 2:
            file.unlink()
        else:
            poses.append(place)
    for number, place in enumerate(poses):
        (folder / f"rgb/{place:06d}.png").rename(folder / f"rgb/x{number:06d}.png")
    truth = tiny_room(FRAMES, WIDTH, HEIGHT)[1].T_world_camera[poses]
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(len(poses)) / _FPS, truth))


def _as_foreign_splats(folder: Path) -> None:
    shutil.rmtree(folder / "rgb")
    (folder / "map.lcc").write_bytes(b"\0" * 4096)


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


def _scaled(T: Array, factor: float) -> Array:
    moved = np.array(T)
    moved[:3, 3] *= factor
    return moved


def _shifted(depth: NDArray, _: int) -> NDArray:
    move = np.array([[1, 0, 8], [0, 1, -4]], np.float32)
    return cv2.warpAffine(depth, move, depth.shape[::-1], flags=cv2.INTER_NEAREST)


def _with_far_value(depth: NDArray, index: int) -> NDArray:
    holes = np.random.default_rng(index).random((HEIGHT // 8, WIDTH // 8)) < 0.15
    return np.where(holes.repeat(8, 0).repeat(8, 1), 65535, depth)


def _with_camera(**factors: float) -> Callable[[Path], None]:
    """States intrinsics that are a factor of the true ones."""

    def change(folder: Path) -> None:
        file = folder / "intrinsics.yaml"
        values = yaml.safe_load(file.read_text())
        values |= {name: factor * values[name] for name, factor in factors.items()}
        file.write_text(yaml.safe_dump(values))

    return change


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


def _with_turned_camera(quarters: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = folder / "intrinsics.yaml"
        values = yaml.safe_load(file.read_text())
        for _ in range(quarters):
            values |= {
                "fx": values["fy"],
                "fy": values["fx"],
                "cx": values["cy"],
                "cy": values["width"] - 1 - values["cx"],
                "width": values["height"],
                "height": values["width"],
            }
        file.write_text(yaml.safe_dump(values))

    return change


def _translated(T: Array) -> Array:
    moved = np.array(T)
    moved[:3, 3] += UTM_M
    return moved


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_UNITY = np.diag([1.0, -1.0, 1.0, 1.0])
_RUN = Kind.job
_GIVEN = (*_RUN, "--poses", "given")
_PRIORS = (
    *(*_RUN, "--depth", "none", "--depth-prior.use", "correct", "--depth-prior.kind", "maps"),
    *("--depth-prior.maps.folder", "FOLDER/priors", "--depth-prior.maps.values"),
)
_CHECK = ("check-data", "--kind", "folder", "--path", "FOLDER")

KINDS: Mapping[str, Kind] = {
    "as it is": Kind("a good map"),
    "65535 where nothing was measured": Kind(
        "the map of the rest", RoomChange(depth=_with_far_value)
    ),
    "given poses of OpenGL": Kind(
        "stops, names the axes", RoomChange(pose=lambda T: T @ OPENGL), job=_GIVEN
    ),
    "given poses from world to camera": Kind(
        "stops, names the inverse", RoomChange(pose=se3.inverse), job=_GIVEN
    ),
    "given poses, left-handed": Kind(
        "stops, names it", RoomChange(pose=lambda T: _UNITY @ T @ _UNITY), job=_GIVEN
    ),
    "given poses in millimetres": Kind(
        "stops, names the unit", RoomChange(pose=lambda T: _scaled(T, 1e3)), job=_GIVEN
    ),
    "given poses in UTM": Kind("a good map", RoomChange(pose=_translated), job=_GIVEN),
    "colour shifted by (-8, +4) px": Kind("the run reports it", RoomChange(depth=_shifted)),
    "focal length 20 % too long": Kind("names the right one", after=_with_camera(fx=1.2, fy=1.2)),
    "focal length 20 % too long, refined": Kind(
        "a good map",
        after=_with_camera(fx=1.2, fy=1.2),
        job=(*_RUN, "--dataset.intrinsics", "refine"),
    ),
    "principal point off by 12 px": Kind("names the right one", after=_with_camera(cx=1.15)),
    "distortion k1 = -0.2, not stated": Kind("names it", _bent(-0.2)),
    "unit of depth off by 25 %": Kind(
        "names the factor", RoomChange(depth=lambda depth, _: 1.25 * depth)
    ),
    "given poses jump by 10 cm": Kind("names the frame", after=_with_a_jump, job=_GIVEN),
    "camera in portrait": Kind(
        "a good map, names the side that is up", _turned(1), _with_turned_camera(1)
    ),
    "camera upside down": Kind(
        "a good map, names the side that is up", _turned(2), _with_turned_camera(2)
    ),
    "times in nanoseconds": Kind("stops, names the unit", after=_with_times_in_nanoseconds),
    "a scene at 6 cm": Kind("a good map", RoomChange(scale=1 / 25)),
    "a scene at 90 m": Kind("a good map", RoomChange(scale=60.0)),
    "TUM layout, own camera": Kind(
        "a good map",
        after=_as_tum_with_own_camera,
        job=("run", "--dataset.kind", "tum", "--dataset.path", "FOLDER"),
    ),
    "transforms_train.json of Blender": Kind(
        "read",
        after=_as_blender,
        job=("check-data", "--kind", "nerfstudio", "--path", "FOLDER"),
    ),
    "hidden files of macOS": Kind("read", after=_with_files_of_macos, job=_CHECK),
    "byte order marks": Kind("read", after=_with_byte_order_marks, job=_CHECK),
    "four black frames at the start": Kind(
        "a good map of the rest",
        RoomChange(
            rgb=lambda rgb, i: rgb * (i >= 4), depth=lambda depth, i: depth * np.uint16(i >= 4)
        ),
    ),
    "half of the depth missing at random": Kind("a good map", _missing_at_random(0.5)),
    "5 % of the depth": Kind("a good map", _missing_at_random(0.05)),
    "depth in every 8th row": Kind("a good map", _in_lines(8)),
    "given poses, no depth": Kind(
        "a good map",
        RoomChange(has_depth=False),
        after=_every_third,
        job=(*_GIVEN, "--depth", "none"),
    ),
    "inverse depth priors, declared as metric": Kind(
        "names the kind", RoomChange(has_depth=False), _with_inverse_priors, (*_PRIORS, "metric")
    ),
    "inverse depth priors, declared as that": Kind(
        "a good map",
        RoomChange(has_depth=False),
        _with_inverse_priors,
        (*_PRIORS, "affine-inverse"),
    ),
    "a splat file of another format": Kind(
        "stops, names the formats",
        after=_as_foreign_splats,
        job=("render", "FOLDER/map.lcc"),
    ),
}
