"""The Open3D examples in apps/ on a tiny map: what they write can be read back."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.images import read_rgb
from toolkit.io.splats import read_splats

APPS = Path(__file__).parents[2] / "apps"


def example(name: str) -> dict:
    return runpy.run_path(str(APPS / name))


@pytest.fixture(scope="module")
def outputs(room_runs, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("open3d_examples")
    to_cloud = example("10_map_to_point_cloud.py")
    assert to_cloud["main"](room_runs.a / "map.ply", folder / "c.ply", folder / "back.ply") == 0
    assert example("11_tsdf_mesh_with_labels.py")["main"](room_runs.a, folder / "m.ply") == 0
    return folder


def test_a_map_becomes_a_point_cloud_and_a_map_again(room_runs, outputs):
    before, after = read_splats(room_runs.a / "map.ply"), read_splats(outputs / "back.ply")
    np.testing.assert_array_equal(after.means, before.means)
    np.testing.assert_allclose(after.log_radii, before.log_radii, atol=1e-5)
    np.testing.assert_allclose(after.opacity_logits, before.opacity_logits, atol=1e-2)
    np.testing.assert_allclose(after.colours, np.clip(before.colours, 0, 1), atol=1 / 255)
    points = open3d().t.io.read_point_cloud(str(outputs / "c.ply")).point
    assert before.labels is not None
    np.testing.assert_array_equal(points["label"].numpy()[:, 0], before.labels.label)


def test_points_of_other_programs_get_a_radius_from_their_spacing():
    o3d = open3d()
    grid = np.mgrid[0:4, 0:4, 0:1].reshape(3, -1).T.astype(np.float32) * 0.1
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(grid))
    gaussians = example("10_map_to_point_cloud.py")["gaussians_from_point_cloud"](cloud)
    np.testing.assert_allclose(gaussians.radii_m.numpy(), 0.05, rtol=1e-4)
    np.testing.assert_allclose(gaussians.means.numpy(), grid)


def test_vertices_of_the_mesh_have_the_class_of_the_map_beside_them(room_runs, outputs):
    mesh = open3d().t.io.read_triangle_mesh(str(outputs / "m.ply"))
    vertices = mesh.vertex["positions"].numpy()
    labels = np.load(outputs / "m.labels.npy")
    assert labels.shape == (len(vertices),)
    splats = read_splats(room_runs.a / "map.ply")
    chosen = np.linspace(0, len(vertices) - 1, 50).astype(int)
    distances = np.linalg.norm(vertices[chosen, None] - splats.means[None], axis=2)
    assert splats.labels is not None
    expected = splats.labels.label[distances.argmin(axis=1)]
    np.testing.assert_array_equal(labels[chosen], expected)
    assert len(np.unique(labels)) > 1
    colours = mesh.vertex["colors"].numpy()
    assert len(np.unique(colours[labels == labels[0]], axis=0)) == 1


def test_both_are_drawn_into_one_picture(outputs):
    files = [str(outputs / name) for name in ("c.ply", "m.ply", "picture.png")]
    # In a process of its own: a broken graphics driver would end the interpreter.
    command = [sys.executable, str(APPS / "12_offscreen_picture.py"), *files]
    result = subprocess.run(command, capture_output=True, text=True)
    if "cannot render off screen" in result.stderr:
        pytest.skip("Open3D has no Vulkan driver: apt-get install libvulkan1 mesa-vulkan-drivers")
    assert result.returncode == 0, result.stderr
    picture = read_rgb(Path(files[2]))
    cloud, mesh = np.split(picture, 2, axis=1)
    for half in (cloud, mesh):
        drawn = (half < 0.99).any(axis=2)
        assert drawn.mean() > 0.2
        assert len(np.unique(half[drawn], axis=0)) > 5  # colours, not one silhouette
