"""Views of training rooms: cameras held by people and robots, rendered depth and labels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from data_tools.training_rooms.rooms import TrainingRoom, random_room
from data_tools.training_rooms.sensors import measured
from data_tools.training_rooms.solids import extent
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d

_MISS = np.uint32(0xFFFFFFFF)
# Nearest surface of a view; views with a larger part within it are of the inside of furniture.
_NEAR_M, _NEAR_PART = 0.35, 0.25
# A view that a single surface fills teaches nothing beyond this part.
_PLAIN_PART = 0.97


@dataclass(frozen=True)
class View:
    """What a sensor measures of a room.

    Attributes:
        depth_m: [H, W] float32, 0 where nothing is measured.
        labels: [H, W] int32 class ids, 0 where no surface is hit.
        camera: intrinsics.
        T_world_camera: [4, 4] pose; the world is z up, with the floor at z = 0.
    """

    depth_m: NDArray[np.float32]
    labels: NDArray[np.int32]
    camera: Camera
    T_world_camera: NDArray[np.float64]


class RenderedRoom:
    """A room ready to be seen.

    Args:
        room: its solids.
        class_ids: class ids by name.
    """

    def __init__(self, room: TrainingRoom, class_ids: Mapping[str, int]) -> None:
        counts = [len(solid.vertices_m) for solid in room.piece]
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        sizes = [len(solid.triangles) for solid in room.piece]
        vertices = np.concatenate([solid.vertices_m for solid in room.piece])
        triangles = np.concatenate(
            [solid.triangles + start for solid, start in zip(room.piece, starts, strict=True)]
        )
        self.room = room
        self._labels = np.repeat([class_ids[solid.name] for solid in room.piece], sizes)
        self._dark = np.repeat([solid.dark for solid in room.piece], sizes)
        tensor = open3d().core.Tensor.from_numpy
        self._casting: Any = open3d().t.geometry.RaycastingScene(nthreads=1)
        self._casting.add_triangles(
            tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32))
        )
        self._targets: dict[str, list[NDArray[np.float64]]] = {}
        for solid in room.piece:
            if solid.name not in _SHELL:
                middle = extent([solid]).mean(axis=0)
                self._targets.setdefault(solid.name, []).append(middle)

    def view(self, rng: Generator, width: int, height: int) -> View | None:
        """A random view as a random sensor measures it; None if there is little in it."""
        camera = _random_camera(rng, width, height)
        T_world_camera = self._pose(rng)
        depth_m, labels, cosine, dark = self._render(camera, T_world_camera)
        seen = np.bincount(labels.ravel()) / labels.size
        if seen.max() > _PLAIN_PART or (depth_m < _NEAR_M).mean() > _NEAR_PART:
            return None
        depth_m = measured(rng, depth_m, cosine, dark)
        return View(depth_m, labels, camera, T_world_camera)

    def _pose(self, rng: Generator) -> NDArray[np.float64]:
        """A camera inside the room that looks at a piece of furniture, or anywhere."""
        width, depth, height = self.room.size_m
        low, high = [0.2, 0.2, 0.2], [width - 0.2, depth - 0.2, height - 0.15]
        eye = rng.uniform(low, high)
        target = rng.uniform([0, 0, 0], [width, depth, 1.6])
        if self._targets and rng.random() < 0.8:
            # A class first: rooms have hundreds of books and one table.
            of_class = list(self._targets.values())[rng.integers(len(self._targets))]
            target = of_class[rng.integers(len(of_class))] + rng.normal(0, 0.3, 3)
            angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 3.5)
            eye[:2] = target[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
        eye[2] = rng.choice([0.5, 1.0, 1.5, 1.6]) + rng.normal(0, 0.25)
        eye = np.clip(eye, low, high)
        ahead = target - eye
        ahead[2] = np.clip(ahead[2], -1.6 * np.hypot(*ahead[:2]), 0.7 * np.hypot(*ahead[:2]))
        return _looking(eye, ahead + 1e-6, rng.normal(0, 0.08))

    def _render(
        self, camera: Camera, T_world_camera: NDArray[np.float64]
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Depth, labels, cosine to the normal and dark surfaces [H, W]."""
        shape = (camera.height, camera.width)
        ahead = camera.rays().reshape(-1, 3) @ T_world_camera[:3, :3].T
        rays = np.empty((len(ahead), 6), np.float32)
        rays[:, :3], rays[:, 3:] = T_world_camera[:3, 3], ahead
        answer = self._casting.cast_rays(open3d().core.Tensor.from_numpy(rays), nthreads=1)
        triangle = answer["primitive_ids"].numpy()
        hit = triangle != _MISS
        triangle = np.where(hit, triangle, 0)
        toward = np.einsum("ij,ij->i", answer["primitive_normals"].numpy(), rays[:, 3:])
        cosine = np.abs(toward) / np.linalg.norm(rays[:, 3:], axis=1)
        depth_m = np.where(hit, answer["t_hit"].numpy(), 0.0).astype(np.float32)
        labels = np.where(hit, self._labels[triangle], 0).astype(np.int32)
        dark = hit & self._dark[triangle]
        return tuple(a.reshape(shape) for a in (depth_m, labels, cosine, dark))  # type: ignore[return-value]


_SHELL = ("floor", "wall", "ceiling")


def training_views(
    rng: Generator,
    class_ids: Mapping[str, int],
    size: tuple[int, int] = (160, 120),
    per_room: int = 8,
    family: str | None = None,
) -> Iterator[View]:
    """Yield views of random rooms without end."""
    while True:
        room = RenderedRoom(random_room(rng, family), class_ids)
        found = 0
        for _ in range(3 * per_room):
            view = room.view(rng, *size)
            if view is not None:
                yield view
                found += 1
            if found == per_room:
                break


def _random_camera(rng: Generator, width: int, height: int) -> Camera:
    focal = width / (2.0 * np.tan(np.radians(rng.uniform(45.0, 90.0)) / 2.0))
    centre = (np.array([width, height]) - 1) / 2 + rng.normal(0, 1.0, 2)
    return Camera(focal, focal, float(centre[0]), float(centre[1]), width, height)


def _looking(eye: NDArray, ahead: NDArray, roll_rad: float) -> NDArray[np.float64]:
    """The pose T_world_camera [4, 4] of a camera at `eye`; x right, y down, z ahead."""
    z = ahead / np.linalg.norm(ahead)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    T = np.eye(4)
    T[:3, :3] = np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)
    T[:3, 3] = eye
    return T
