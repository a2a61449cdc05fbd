"""Quality of a reconstructed mesh against the ground-truth mesh of the scene.

Points are sampled on both meshes, uniformly by area, and compared with the nearest point of the
other mesh: accuracy from the reconstruction to the truth, completion the other way. Surfaces that
no frame observed, such as the back of furniture, do not count for completion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.meshes import TriangleMesh
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.trajectory import TrajectoryAlignment

SAMPLES = 100_000
_COMPLETION_CM = 5
_F_SCORES_CM = (1, 2, 5)
# A point of the true mesh is visible if the first surface on its ray is at most this much nearer.
_OCCLUSION_M = 0.03
_SEED = 0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Views:
    """The views of a run, which determine the observed part of the true mesh.

    Attributes:
        camera: intrinsics of all views.
        T_map_camera: poses [4, 4].
        max_depth_m: maximum depth that was fused, in metres.
    """

    camera: Camera
    T_map_camera: Sequence[Array]
    max_depth_m: float


@dataclass(frozen=True)
class MeshQuality:
    """Distances and agreement of normals of the samples of both meshes.

    Attributes:
        accuracy_m: [N] distances of samples of the reconstruction to the true mesh, in metres.
        completion_m: [M] distances of observed samples of the true mesh to the reconstruction.
        accuracy_cosines, completion_cosines: [N], [M] absolute cosines of the normals.
        observed: fraction of the samples of the true mesh that were observed.
    """

    accuracy_m: Array
    completion_m: Array
    accuracy_cosines: Array
    completion_cosines: Array
    observed: float

    def f_score(self, threshold_m: float) -> float:
        """Return the harmonic mean of precision and recall at a distance, in [0, 1]."""
        precision = float((self.accuracy_m <= threshold_m).mean())
        recall = float((self.completion_m <= threshold_m).mean())
        return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0

    def metrics(self, voxel_m: float) -> Metrics:
        """Return the metrics by name.

        Args:
            voxel_m: voxel size of the reconstruction, for the text of the convention.
        """
        if len(self.completion_m) == 0:
            return {}
        cosines = (self.accuracy_cosines.mean() + self.completion_cosines.mean()) / 2
        complete = (self.completion_m <= _COMPLETION_CM / 100).mean()
        return {
            "accuracy_cm": 100 * float(self.accuracy_m.mean()),
            "completion_cm": 100 * float(self.completion_m.mean()),
            "completion_ratio_percent": 100 * float(complete),
            **{f"f_score_{cm}cm_percent": 100 * self.f_score(cm / 100) for cm in _F_SCORES_CM},
            "normal_consistency": float(cosines),
            "observed_percent": 100 * self.observed,
            "convention": (
                f"mesh fused from renders with voxels of {1000 * voxel_m:g} mm; {SAMPLES} samples "
                "per mesh by area, distances to the nearest point of the other mesh (means); "
                f"completion ratio within {_COMPLETION_CM} cm; only the part of the true mesh that "
                "a rendered view observes, occlusion included; normal consistency is the mean "
                "absolute cosine in both directions"
            ),
        }


def mesh_quality(
    mesh: TriangleMesh, truth: Path, alignment: TrajectoryAlignment, views: Views
) -> MeshQuality:
    """Compare a reconstruction with the true mesh.

    Args:
        mesh: the reconstruction, in the frame of the map.
        truth: file of the true mesh, in the frame of the ground-truth poses.
        alignment: transformation from the map to that frame.
        views: views from which the mesh was fused.

    Raises:
        DatasetError: the file does not exist.
        FormatError: the true mesh cannot be read or is empty.
    """
    vertices_m = se3.transform_points(
        alignment.T_world_map, alignment.scale * mesh.vertices_m.astype(np.float64)
    )
    estimate = _Surface(vertices_m, mesh.triangles)
    true = _Surface.read(truth)
    generator = np.random.default_rng(_SEED)
    points_m, normals = estimate.samples(SAMPLES, generator)
    true_points_m, true_normals = true.samples(SAMPLES, generator)
    seen = _observed(true, true_points_m, alignment, views)
    accuracy_m, accuracy_cosines = true.compare(points_m, normals)
    completion_m, completion_cosines = estimate.compare(true_points_m[seen], true_normals[seen])
    return MeshQuality(
        accuracy_m, completion_m, accuracy_cosines, completion_cosines, float(seen.mean())
    )


def _observed(
    true: _Surface, points_m: Array, alignment: TrajectoryAlignment, views: Views
) -> NDArray[np.bool_]:
    """Return which points [N] of the true mesh lie unoccluded in any view."""
    camera = views.camera
    seen = np.zeros(len(points_m), bool)
    for T_map_camera in views.T_map_camera:
        T_world_camera = alignment.T_world_map @ T_map_camera
        T_world_camera[:3, 3] = se3.transform_points(
            alignment.T_world_map, alignment.scale * T_map_camera[None, :3, 3]
        )[0]
        open_ = np.flatnonzero(~seen)
        x, y, z = se3.transform_points(se3.inverse(T_world_camera), points_m[open_]).T
        depth = np.maximum(z, 1e-6)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        inside = (z > 0) & (z <= alignment.scale * views.max_depth_m)
        inside &= (u >= -0.5) & (u < camera.width - 0.5)
        inside &= (v >= -0.5) & (v < camera.height - 0.5)
        candidates = open_[inside]
        seen[candidates] = true.visible(T_world_camera[:3, 3], points_m[candidates])
    return seen


class _Surface:
    """Samples, nearest points and rays of a mesh."""

    def __init__(self, vertices_m: Array, triangles: NDArray[np.integer]) -> None:
        self._o3d = open3d()
        self._corners = vertices_m[triangles]
        sides = self._corners[:, 1:] - self._corners[:, :1]
        cross = np.cross(sides[:, 0], sides[:, 1])
        double_area = np.linalg.norm(cross, axis=1)
        self._normals = cross / np.maximum(double_area, 1e-12)[:, None]
        self._shares = double_area / max(float(double_area.sum()), 1e-12)
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(vertices_m),
            self._o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
        )

    @classmethod
    def read(cls, path: Path) -> _Surface:
        if not path.is_file():
            raise DatasetError(f"mesh {path} does not exist; check the path")
        mesh = open3d().io.read_triangle_mesh(str(path))
        if len(mesh.triangles) == 0:
            raise FormatError(f"{path} contains no triangles; give a triangle mesh (.ply, .obj)")
        return cls(np.asarray(mesh.vertices), np.asarray(mesh.triangles))

    def samples(self, count: int, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return points [N, 3], uniform by area, and the normals of their triangles."""
        index = generator.choice(len(self._shares), count, p=self._shares / self._shares.sum())
        a, b = generator.random((2, count))
        folded = a + b > 1
        a, b = np.where(folded, 1 - a, a), np.where(folded, 1 - b, b)
        corners = self._corners[index]
        weights = np.stack([1 - a - b, a, b], axis=1)
        return np.einsum("nk,nkd->nd", weights, corners), self._normals[index]

    def compare(self, points_m: Array, normals: Array) -> tuple[Array, Array]:
        """Return distances [N] to the nearest points, and absolute cosines of the normals."""
        if len(points_m) == 0:
            return np.empty(0), np.empty(0)
        found = self._scene.compute_closest_points(self._tensor(points_m))
        distances_m = np.linalg.norm(points_m - found["points"].numpy(), axis=1)
        nearest = self._normals[found["primitive_ids"].numpy().astype(np.int64)]
        return distances_m, np.abs(np.einsum("nd,nd->n", normals, nearest))

    def visible(self, position_m: Array, points_m: Array) -> NDArray[np.bool_]:
        """Return which points [N] can be seen from a position."""
        if len(points_m) == 0:
            return np.zeros(0, bool)
        offsets = points_m - position_m
        length_m = np.linalg.norm(offsets, axis=1)
        directions = offsets / np.maximum(length_m, 1e-9)[:, None]
        rays = np.concatenate([np.broadcast_to(position_m, offsets.shape), directions], axis=1)
        hit_m = self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy()
        return np.asarray(hit_m >= length_m - _OCCLUSION_M)

    def _tensor(self, values: Array) -> Any:
        return self._o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))
