"""Image sequences of a camera that moves through the painted box, or only turns in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from painted_box import box_frames

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.trajectory import align

WIDTH, HEIGHT = 160, 120


def walk(frames: int = 14) -> NDArray[np.float64]:
    """Poses [N, 4, 4] of a walk to the side."""
    return np.array(
        [se3.exp([0.04 * n, 0.02 * np.sin(n), 0.02 * n, 0.0, 0.01 * n, 0.0]) for n in range(frames)]
    )


def turn(frames: int = 14) -> NDArray[np.float64]:
    """Poses [N, 4, 4] of a camera that turns in place."""
    return np.array([se3.exp([0.0, 0.0, 0.0, 0.0, 0.03 * n, 0.0]) for n in range(frames)])


def wind(frames: int = 24) -> NDArray[np.float64]:
    """Poses [N, 4, 4] of a walk with turns that make the focal length observable."""
    poses = []
    for n in range(frames):
        y, *turns = (a * np.sin(n / b) for a, b in ((0.1, 4), (0.15, 3), (0.25, 5), (0.1, 4)))
        poses.append(se3.exp([0.05 * n, y, 0.03 * n, *turns]))
    return np.array(poses)


def film(T_world_camera: NDArray[np.float64]) -> list[Frame]:
    """The images at some poses, with fine patterns on the walls; they have true depth, too."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(12, 3))
    waves *= (rng.uniform(6.0, 30.0, 12) / np.linalg.norm(waves, axis=1))[:, None]
    phases = rng.uniform(0.0, 6.3, (3, 12))
    frames = []
    for frame, T in zip(box_frames(T_world_camera, WIDTH, HEIGHT), T_world_camera, strict=True):
        points = se3.transform_points(T, frame.camera.unproject(frame.depth_m))
        paint = [0.5 + 0.07 * np.sin(points @ waves.T + phase).sum(-1) for phase in phases]
        rgb = np.stack(paint, -1).clip(0.0, 1.0).astype(np.float32)
        frames.append(replace(frame, rgb=rgb))
    return frames


class Film:
    """Frames in memory as a dataset."""

    def __init__(self, frames: list[Frame]) -> None:
        self.name, self.camera = "film", frames[0].camera
        self.ground_truth: Trajectory | None = None
        self.label_names: dict[int, str] | None = None
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]

    def __iter__(self):
        return iter(self._frames)


def error_m(found: Trajectory, truth: NDArray[np.float64]) -> tuple[float, float]:
    """RMS distance of the positions after alignment with scale, and the scale."""
    positions = found.T_world_camera[:, :3, 3]
    a = align(positions, truth[:, :3, 3], with_scale=True)
    aligned = a.scale * positions @ a.T_world_map[:3, :3].T + a.T_world_map[:3, 3]
    return float(np.sqrt(((aligned - truth[:, :3, 3]) ** 2).sum(1).mean())), a.scale
