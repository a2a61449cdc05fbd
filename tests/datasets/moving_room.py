"""A box room seen by a shaking camera; every row of an image is exposed at its own time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import images
from toolkit.io.trajectories import write_tum

Array = NDArray[np.float64]

CAMERA = Camera(90.0, 90.0, 47.5, 35.5, 96, 72)
# Half sizes of the room, in metres.
_HALF = np.array([2.0, 1.3, 2.4])
_COLOURS = np.array([[7.0, 3.0, 9.0], [5.0, 8.0, -4.0], [6.0, -7.0, 5.0]])


def pose(time_s: float) -> Array:
    """T_world_camera [4, 4] of a hand that moves and shakes."""
    phases = np.array([0.3, 1.1, 2.0, 0.7, 1.9, 2.6])
    hertz = np.array([0.5, 0.7, 0.6, 0.9, 0.8, 0.7])
    size = np.array([0.15, 0.1, 0.15, 0.12, 0.15, 0.1])
    return se3.exp(size * np.sin(2 * np.pi * hertz * time_s + phases))


def exposed(times_s: Array, k1: float = 0.0) -> tuple[NDArray, NDArray]:
    """Colour [H, W, 3] and depth [H, W] of an image whose rows have these times [H].

    Args:
        k1: radial distortion of the lens.
    """
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    bent = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy], axis=-1)
    straight = bent
    for _ in range(10):
        straight = bent / (1.0 + k1 * (straight**2).sum(axis=-1, keepdims=True))
    rays = np.concatenate([straight, np.ones((*u.shape, 1))], axis=-1)
    poses = np.array([pose(t) for t in times_s])
    directions = np.einsum("vij,vuj->vui", poses[:, :3, :3], rays)
    centres = poses[:, None, :3, 3]
    depth_m = ((np.sign(directions) * _HALF - centres) / directions).min(axis=-1)
    points = centres + depth_m[..., None] * directions
    rgb = 0.5 + 0.4 * np.sin(points @ _COLOURS) * np.cos(2.3 * points[..., ::-1])
    return rgb.astype(np.float32), depth_m.astype(np.float32)


class MovingRoom:
    """A recording of the room; frames are rendered on access.

    Args:
        timestamps_s: [N] of the frames.
        readout_s: time from the exposure of the first row to that of the last.
        delay_s: time from the exposure of colour to that of depth.
        taken_s: [N] when the frames were taken, by default at their timestamps.
    """

    def __init__(
        self,
        timestamps_s: Array,
        readout_s: float = 0.0,
        delay_s: float = 0.0,
        taken_s: Array | None = None,
    ) -> None:
        self.timestamps_s = timestamps_s
        self._readout_s, self._delay_s = readout_s, delay_s
        self._taken_s = timestamps_s if taken_s is None else taken_s

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def __getitem__(self, index: int) -> Frame:
        rows = (np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5
        times_s = self._taken_s[index] + self._readout_s * rows
        rgb, depth_m = exposed(times_s)
        if self._delay_s:
            depth_m = exposed(times_s + self._delay_s)[1]
        return Frame(index, float(self.timestamps_s[index]), rgb, depth_m, CAMERA)


def write_recording(folder: Path, times_s: Array, k1: float = 0.0) -> Path:
    """Write frames of the room and their true poses into a folder, at regular times."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i, time_s in enumerate(times_s):
        rgb, depth_m = exposed(np.full(CAMERA.height, time_s), k1)
        images.write_rgb(folder / f"rgb/{i:04d}.png", rgb)
        images.write_depth_png(folder / f"depth/{i:04d}.png", depth_m, 5000.0)
    names = ("fx", "fy", "cx", "cy", "width", "height")
    intrinsics = {name: getattr(CAMERA, name) for name in names}
    fps = round(1.0 / float(times_s[1] - times_s[0]), 6)
    (folder / "intrinsics.yaml").write_text(
        yaml.safe_dump(intrinsics | {"depth_scale": 5000.0, "fps": fps})
    )
    write_tum(folder / "trajectory.txt", Trajectory(times_s, np.array([*map(pose, times_s)])))
    return folder
