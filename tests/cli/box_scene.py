"""A box of Gaussians that is its own truth: frames are renders of the map itself."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import backend, render_surface

CAMERA = Camera(fx=40.0, fy=40.0, cx=31.5, cy=23.5, width=64, height=48)
# Where the map lies in the world of the truth: nothing may rely on the two being one.
T_WORLD_MAP = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 1.2]))


@dataclass
class RenderedDataset:
    """Frames of a map at given poses, as a data set in memory."""

    frames: Sequence[Frame]
    ground_truth: Trajectory | None
    name: str = "box"
    camera: Camera = CAMERA
    label_names: None = None

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]


def box_map() -> GaussianCloud:
    """Walls of a box of 4 m around the origin, in soft random colours."""
    generator = np.random.default_rng(0)
    grid = np.arange(-2.0, 2.01, 0.1)
    a, b = (axis.ravel() for axis in np.meshgrid(grid, grid))
    wall = np.full_like(a, 2.0)
    sides = [np.roll(np.stack([a, b, s * wall], 1), k, axis=1) for k in range(3) for s in (-1, 1)]
    points = np.concatenate(sides)
    wave = generator.normal(size=(3, 3)) * 4.0
    colours = 0.5 + 0.3 * np.sin(points @ wave) + generator.uniform(-0.1, 0.1, points.shape)
    n = len(points)
    return GaussianCloud.from_values(
        means=torch.tensor(points, dtype=torch.float32),
        radii_m=torch.full((n,), 0.07),
        opacities=torch.full((n,), 0.95),
        colours=torch.tensor(colours, dtype=torch.float32),
    )


def poses(count: int, seed: int) -> np.ndarray:
    """T_map_camera [count, 4, 4] of a shaky camera that looks at one wall."""
    generator = np.random.default_rng(seed)
    return np.stack([se3.exp(generator.uniform(-0.25, 0.25, 6)) for _ in range(count)])


def frames_at(gaussians: GaussianCloud, T_map_camera: np.ndarray) -> list[Frame]:
    """What a perfect camera sees there."""
    frames = []
    for index, T in enumerate(T_map_camera):
        drawn = render_surface(backend(), gaussians, CAMERA, se3.inverse(T))
        rgb = drawn.output.colour.clamp(0.0, 1.0).contiguous().numpy()
        frames.append(Frame(index, index / 30.0, rgb, drawn.depth_m.numpy(), CAMERA))
    return frames


def rendered_dataset(gaussians: GaussianCloud, T_map_camera: np.ndarray) -> RenderedDataset:
    """A data set whose truth is in the world, `T_WORLD_MAP` away from the map."""
    times = np.arange(len(T_map_camera)) / 30.0
    truth = Trajectory(times, T_WORLD_MAP @ T_map_camera)
    return RenderedDataset(frames_at(gaussians, T_map_camera), truth)


def frames_content(
    tracked: int,
    keyframes: Sequence[int],
    held_out: Collection[int] = (),
    lost: Sequence[int] = (),
) -> dict[str, Any]:
    """The content of frames.json of a run whose frames from 0 on were tracked at 30 per second."""
    exposure = {"gain": 1.0, "bias": 0.0, "balance": [1.0, 1.0, 1.0]}
    states = [{"index": i, "state": "tracked", "part": 0} for i in range(tracked)]
    return {
        "frames": [
            {"index": i, "timestamp_s": i / 30.0, **exposure, "held_out": i in held_out}
            for i in range(tracked)
        ],
        "states": [*states, *({"index": i, "state": "lost"} for i in lost)],
        "lost": list(lost),
        "keyframes": list(keyframes),
        "parts": [
            {
                "number": 0,
                "submaps": [],
                "frames": tracked,
                "first": 0,
                "last": tracked - 1,
                "loss": None,
            }
        ],
        "submaps": [],
        "camera": asdict(CAMERA),
        "metric": True,
    }
