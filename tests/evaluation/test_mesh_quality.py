"""Mesh metrics on planes whose distances are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.meshes import TriangleMesh, write_mesh
from toolkit.runs.evaluation.meshes import Views, mesh_quality
from toolkit.runs.evaluation.trajectory import TrajectoryAlignment

CAMERA = Camera(fx=50.0, fy=50.0, cx=49.5, cy=49.5, width=100, height=100)
VIEWS = Views(CAMERA, [np.eye(4)], max_depth_m=6.0)


def plane(z: float, width: float = 1.0, height: float = 1.0) -> TriangleMesh:
    """A rectangle around the optical axis at a depth; its left edge is at x = -0.5."""
    x, y = (-0.5, width - 0.5), (-height / 2, height / 2)
    corners = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriangleMesh(corners.astype(np.float32), np.zeros((4, 3), np.float32), triangles)


def both(a: TriangleMesh, b: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        np.concatenate([a.vertices_m, b.vertices_m]),
        np.concatenate([a.colours, b.colours]),
        np.concatenate([a.triangles, b.triangles + len(a.vertices_m)]),
    )


def compared(tmp_path: Path, estimate: TriangleMesh, truth: TriangleMesh, views=VIEWS, **alignment):
    write_mesh(tmp_path / "truth.ply", truth)
    return mesh_quality(
        estimate,
        tmp_path / "truth.ply",
        TrajectoryAlignment(alignment.get("T", np.eye(4)), alignment.get("scale", 1.0)),
        views,
    ).metrics(0.01)


def test_a_shifted_plane_has_its_shift_as_error(tmp_path):
    metrics = compared(tmp_path, plane(2.015), plane(2.0))
    assert metrics["accuracy_cm"] == pytest.approx(1.5, abs=1e-3)
    assert metrics["completion_cm"] == pytest.approx(1.5, abs=1e-3)
    assert metrics["f_score_1cm_percent"] == 0.0
    assert metrics["f_score_2cm_percent"] == 100.0
    assert metrics["normal_consistency"] == pytest.approx(1.0)
    assert metrics["observed_percent"] == 100.0


def test_a_missing_half_costs_completion_but_not_accuracy(tmp_path):
    metrics = compared(tmp_path, plane(2.0, width=0.5), plane(2.0))
    assert metrics["accuracy_cm"] == pytest.approx(0.0, abs=1e-4)
    # Half is there, and 5 cm beside it count as well.
    assert metrics["completion_ratio_percent"] == pytest.approx(55.0, abs=1.0)
    recall = 0.51
    assert metrics["f_score_1cm_percent"] == pytest.approx(100 * 2 * recall / (1 + recall), abs=1.0)


def test_hidden_surfaces_and_those_outside_of_all_views_do_not_count(tmp_path):
    hidden = both(plane(2.0), plane(2.5))
    metrics = compared(tmp_path, plane(2.0), hidden)
    assert metrics["completion_ratio_percent"] == 100.0
    assert metrics["observed_percent"] == pytest.approx(50.0, abs=1.0)
    behind = both(plane(2.0), plane(-2.0))
    metrics = compared(tmp_path, plane(2.0), behind)
    assert metrics["completion_ratio_percent"] == 100.0


def test_the_mesh_is_compared_in_the_world_of_the_truth(tmp_path):
    T_world_map = se3.exp(np.array([0.4, -1.0, 0.7, 0.2, 0.5, -0.3]))
    true = plane(2.0)
    moved = TriangleMesh(
        se3.transform_points(T_world_map, true.vertices_m).astype(np.float32),
        true.colours,
        true.triangles,
    )
    half = TriangleMesh(true.vertices_m / 2, true.colours, true.triangles)
    metrics = compared(tmp_path, half, moved, T=T_world_map, scale=2.0)
    assert metrics["accuracy_cm"] == pytest.approx(0.0, abs=1e-3)
    assert metrics["observed_percent"] == 100.0


def test_crossed_planes_disagree_in_their_normals(tmp_path):
    tilted = plane(0.0)
    a = np.deg2rad(60.0)
    R = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    points = (tilted.vertices_m @ R.T + [0, 0, 2.0]).astype(np.float32)
    tilted = TriangleMesh(points, tilted.colours, tilted.triangles)
    assert compared(tmp_path, tilted, plane(2.0))["normal_consistency"] == pytest.approx(0.5)


def test_a_file_without_triangles_is_reported(tmp_path):
    (tmp_path / "truth.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    with pytest.raises(FormatError, match="contains no triangles"):
        mesh_quality(plane(2.0), tmp_path / "truth.ply", TrajectoryAlignment(np.eye(4)), VIEWS)
