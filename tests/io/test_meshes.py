"""Meshes fused from depth images of a known plane, and mesh files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import FormatError, RunFolderError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.meshes import PosedDepth, TriangleMesh, fuse_views, write_mesh, write_points

CAMERA = Camera(70.0, 70.0, 39.5, 29.5, 80, 60)
# A slanted plane, because a shift of half a pixel changes depth only on slanted surfaces.
NORMAL = np.array([0.5, 0.2, -0.84]) / np.linalg.norm([0.5, 0.2, -0.84])
OFFSET_M = NORMAL @ [0.0, 0.0, 2.0]


def view_of_plane(T_world_camera: np.ndarray) -> PosedDepth:
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    depth_m = (OFFSET_M - NORMAL @ T_world_camera[:3, 3]) / (rays @ NORMAL)
    points = T_world_camera[:3, 3] + rays * depth_m[..., None]
    return PosedDepth(
        CAMERA, T_world_camera, colour_at(points).astype(np.float32), depth_m.astype(np.float32)
    )


def colour_at(points: np.ndarray) -> np.ndarray:
    return 0.5 + 0.4 * np.sin(2.0 * points)


def views() -> Iterator[PosedDepth]:
    for step in range(-2, 3):
        yield view_of_plane(se3.exp(np.array([0.1 * step, 0.05 * step, 0, 0, 0.05 * step, 0])))


@pytest.fixture(scope="module")
def plane() -> TriangleMesh:
    return fuse_views(views(), voxel_m=0.04)


def test_fused_plane_has_the_correct_position(plane):
    distance_m = plane.vertices_m @ NORMAL - OFFSET_M
    assert len(plane.triangles) > 1000
    # Without the half-pixel shift of Open3D's convention the mean error is about 15 mm.
    assert abs(distance_m.mean()) < 0.001
    assert np.abs(distance_m).max() < 0.04


def test_fused_colours_match_the_surface(plane):
    error = plane.colours - colour_at(plane.vertices_m)
    assert np.sqrt((error**2).mean()) < 0.02


def test_one_view_suffices_and_depth_beyond_the_maximum_is_ignored():
    near = fuse_views([view_of_plane(np.eye(4))], voxel_m=0.05, max_depth_m=2.0)
    assert len(near.triangles) > 0
    assert near.vertices_m[:, 2].max() < 2.2


def test_empty_views_are_skipped_and_only_empty_views_raise():
    full = view_of_plane(np.eye(4))
    empty = PosedDepth(CAMERA, np.eye(4), full.rgb, np.zeros_like(full.depth_m))
    assert len(fuse_views([empty, full], voxel_m=0.05).triangles) > 0
    with pytest.raises(ToolkitError, match="no view has depth"):
        fuse_views([empty], voxel_m=0.05)


@pytest.mark.parametrize("size", [(60, 80), (62, 83)])
def test_views_with_little_depth_do_not_fail(size):
    full = view_of_plane(np.eye(4))
    height, width = size
    camera = Camera(70.0, 70.0, 39.5, 29.5, width, height)
    rgb = np.full((*size, 3), 0.5, np.float32)
    for row, column in ((0, 0), (1, 1), (28, 40), (height - 1, width - 1), (height - 4, 0)):
        speck = np.zeros(size, np.float32)
        speck[row, column] = 2.0
        view = PosedDepth(camera, np.eye(4), rgb, speck)
        assert len(fuse_views([view, full], voxel_m=0.05).triangles) > 0


def test_mesh_file_round_trip(plane, tmp_path: Path):
    path = tmp_path / "mesh.ply"
    write_mesh(path, plane)
    read = open3d().io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(np.asarray(read.vertices), plane.vertices_m, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(read.triangles), plane.triangles)
    np.testing.assert_allclose(np.asarray(read.vertex_colors), plane.colours, atol=0.5 / 255)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_point_cloud_file_round_trip(tmp_path: Path, suffix):
    generator = np.random.default_rng(0)
    points, colours = generator.normal(size=(50, 3)), generator.uniform(size=(50, 3))
    path = tmp_path / f"points{suffix}"
    write_points(path, points, colours)
    read = open3d().io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(read.points), points, atol=1e-6)
    np.testing.assert_allclose(np.asarray(read.colors), colours, atol=1.0 / 255)


def test_errors_name_the_wrong_suffix_and_the_missing_folder(plane, tmp_path: Path):
    with pytest.raises(FormatError, match=r"mesh\.doc.*\.ply"):
        write_mesh(tmp_path / "mesh.doc", plane)
    with pytest.raises(RunFolderError, match="absent"):
        write_mesh(tmp_path / "absent" / "mesh.ply", plane)
