"""Shape embeddings of classes, measured in labelled scans or on meshes."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.base.geometry.se3 import transform_points
from toolkit.base.geometry.voxels import voxel_keys, voxels_of, voxels_of_keys
from toolkit.semantics.taxonomy_building.shape_statistics import instances, shape_statistics
from toolkit.semantics.taxonomy_parsing import folded

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")

_UP: tuple[float, float, float] = (0.0, 0.0, 1.0)
_SAMPLES = 4000  # points sampled on a mesh
_VOXEL_M = 0.03  # size of the voxels of a scan
_MAX_IDS = 1 << 16  # label images have 16 bits


@dataclass(frozen=True)
class LabelledScan:
    """A labelled point cloud.

    Attributes:
        points_m: [N, 3] float64 in metres.
        class_ids: [N] integers, 0 is void.
        names: class names by id.
        up: unit vector away from the floor. If it is None, it is estimated from the points of the
            floor, or it is z if no class is named floor.
    """

    points_m: Array
    class_ids: NDArray[np.integer]
    names: Mapping[int, str]
    up: Array | None = None

    def up_and_floor(self) -> tuple[Array, float]:
        """Return the up direction and the height of the floor, or of the lowest point."""
        floors = [number for number, name in self.names.items() if folded(name) == "floor"]
        floor = self.points_m[np.isin(self.class_ids, floors)]
        up = np.array(_UP) if self.up is None else np.asarray(self.up, np.float64)
        if self.up is None and len(floor) >= 3:
            up = np.linalg.eigh(np.cov(floor.T))[1][:, 0]
            if (self.points_m.mean(axis=0) - floor.mean(axis=0)) @ up < 0:
                up = -up
        heights = floor @ up if len(floor) else self.points_m @ up
        return up, float(np.median(heights) if len(floor) else heights.min())


def labelled_scan(views: Iterable[tuple[Frame, Array]], names: Mapping[int, str]) -> LabelledScan:
    """Fuse labelled frames to a point cloud with one point per voxel and majority labels.

    Args:
        views: frames with labels, and their poses [4, 4], camera to world.
        names: class names by id.

    Raises:
        DatasetError: a frame has no labels, or no pixel has both depth and a label.
    """
    keys, labels = [], []
    for frame, T_world_camera in views:
        if frame.labels is None:
            raise DatasetError(f"frame {frame.index} has no labels; use a labelled sequence")
        seen = (frame.depth_m > 0) & (frame.labels > 0)
        points = transform_points(T_world_camera, frame.camera.unproject(frame.depth_m)[seen])
        keys.append(voxel_keys(voxels_of(points, _VOXEL_M)))
        labels.append(frame.labels[seen].astype(np.int64))
    if not keys or not sum(map(len, keys)):
        raise DatasetError("no pixel has both depth and a label; check the labels of the sequence")
    voxels, index = np.unique(np.concatenate(keys), return_inverse=True)
    votes, counts = np.unique(index * _MAX_IDS + np.concatenate(labels), return_counts=True)
    winner = np.zeros(len(voxels), np.int64)
    order = np.argsort(counts, kind="stable")  # the most frequent label is written last
    winner[votes[order] // _MAX_IDS] = votes[order] % _MAX_IDS
    return LabelledScan((voxels_of_keys(voxels).astype(np.float64) + 0.5) * _VOXEL_M, winner, names)


class ScanShapes:
    """Mean shape statistics of the objects of each class in labelled scans.

    Args:
        scans: one or more labelled scans.
        gap_m: minimum distance between objects of a class in metres; radius of DBSCAN.
    """

    def __init__(self, scans: Sequence[LabelledScan], gap_m: float = 0.1) -> None:
        self._scans = scans
        self._gap_m = gap_m

    def embeddings(self, classes: Sequence[str]) -> dict[str, Array]:
        """Return STATISTICS averaged over objects, for the classes in the scans.

        Raises:
            DependencyError: Open3D is missing.
        """
        measured: dict[str, list[Array]] = {}
        for scan in self._scans:
            up, floor_m = scan.up_and_floor()
            for number in np.unique(scan.class_ids):
                name = folded(scan.names.get(int(number), ""))
                points = scan.points_m[scan.class_ids == number]
                for piece in instances(points, self._gap_m):
                    measured.setdefault(name, []).append(shape_statistics(piece, up, floor_m))
        known = {c: np.mean(measured[folded(c)], axis=0) for c in classes if folded(c) in measured}
        logger.info("Measured the shapes of %d of %d classes.", len(known), len(classes))
        return known


class MeshShapes:
    """Mean shape statistics of meshes in a folder, with files named after their class.

    `chair.ply`, `chair_2.obj` and `chair 3.stl` are three chairs. The floor is at the lowest point
    of each mesh.

    Args:
        folder: folder of .ply, .obj, .stl, .off, .glb or .gltf files.
        up: up direction of the meshes; many collections use y, (0, 1, 0).
    """

    def __init__(self, folder: str | Path, up: Sequence[float] = _UP) -> None:
        self._folder = Path(folder)
        self._up = np.asarray(up, np.float64) / np.linalg.norm(up)

    def embeddings(self, classes: Sequence[str]) -> dict[str, Array]:
        """Return STATISTICS averaged over meshes, for the classes that have a mesh.

        Raises:
            FormatError: no class has a mesh, or a file does not contain a mesh.
            DependencyError: Open3D is missing.
        """
        by_name = {folded(c): c for c in classes}
        measured: dict[str, list[Array]] = {}
        for path in sorted(self._folder.glob("*")):
            name = by_name.get(folded(path.stem)) or by_name.get(_without_number(path.stem))
            if path.suffix.lower() in MESH_SUFFIXES and name:
                points = _surface_points(path)
                floor_m = float((points @ self._up).min())
                statistics = shape_statistics(points, self._up, floor_m)
                measured.setdefault(name, []).append(statistics)
        if not measured:
            raise FormatError(
                f"{self._folder}: no mesh is named after a class; name files like 'chair.ply'"
            )
        return {name: np.mean(rows, axis=0) for name, rows in measured.items()}


def _without_number(stem: str) -> str:
    return folded(re.sub(r"[\s_-]*\d+$", "", stem))


def _surface_points(path: Path) -> Array:
    """Sample points [_SAMPLES, 3] uniformly on a mesh, deterministically."""
    # Open3D's legacy reader omits polygons with more than three vertices from .obj files.
    try:
        mesh = open3d().t.io.read_triangle_mesh(str(path))
        vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    except (IndexError, KeyError, RuntimeError) as error:  # raised for files without a mesh
        raise FormatError(f"{path}: contains no triangle mesh that Open3D can read") from error
    corners = vertices.astype(np.float64)[triangles]
    if len(corners) == 0 or not np.isfinite(corners).all():
        raise FormatError(f"{path}: contains no triangles, or vertices that are not finite")
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = np.linalg.norm(np.cross(a, b), axis=1)
    if not areas.sum() > 0:
        raise FormatError(f"{path}: all triangles have no area")
    generator = np.random.default_rng(0)
    chosen = generator.choice(len(corners), _SAMPLES, p=areas / areas.sum())
    u, v = generator.random((2, _SAMPLES, 1))
    folds = u + v > 1  # mirror the other half of the parallelogram into the triangle
    u, v = np.where(folds, 1 - u, u), np.where(folds, 1 - v, v)
    return corners[chosen, 0] + u * a[chosen] + v * b[chosen]
