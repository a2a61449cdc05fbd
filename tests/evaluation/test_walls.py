"""Thickness of walls: shifted walls are thin, duplicated ones are thick."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.io.meshes import TriangleMesh, write_mesh
from toolkit.runs.evaluation.walls import wall_thickness
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.scene import InMemoryScene


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """A wall of 2 x 2 m at z = 1."""
    corners = np.array([[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1]], np.float32)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    path = tmp_path_factory.mktemp("wall") / "mesh.ply"
    write_mesh(path, TriangleMesh(corners, np.zeros((4, 3), np.float32), triangles))
    return path


def cloud(offsets_m, count=6000, opacity=0.9, seed=0):
    """Gaussians on the wall, each with one of the offsets along its normal."""
    g = np.random.default_rng(seed)
    means = np.column_stack([g.uniform(0, 2, (count, 2)), 1.0 + g.choice(offsets_m, count)])
    values = torch.from_numpy(means.astype(np.float32))
    return GaussianCloud.from_values(
        values, torch.full((count,), 0.01), torch.full((count,), opacity), torch.zeros(count, 3)
    )


def figures(gaussians, wall, T=None):
    return wall_thickness(InMemoryScene(gaussians), wall, np.eye(4) if T is None else T).metrics()


def test_a_single_wall_is_thin(wall):
    assert figures(cloud([0.0]), wall)["thickness_cm"] < 0.01


def test_a_shift_is_no_thickness(wall):
    assert figures(cloud([0.03]), wall)["thickness_cm"] < 0.01


def test_a_duplicated_wall_is_as_thick_as_its_copies_are_apart(wall):
    found = figures(cloud([0.0, 0.04]), wall)
    assert found["thickness_cm"] == pytest.approx(4.0, abs=0.1)
    assert found["thickness_p95_cm"] == pytest.approx(4.0, abs=0.1)


def test_the_map_is_carried_into_the_world_first(wall):
    T_world_map = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.3]))
    moved = cloud([0.0, 0.04]).transformed(se3.inverse(T_world_map))
    assert figures(moved, wall, T_world_map)["thickness_cm"] == pytest.approx(4.0, abs=0.1)


def test_haze_and_floaters_are_no_wall(wall):
    haze = cloud([0.1], count=2000, opacity=0.2)
    floaters = cloud([0.8], count=1500, seed=1)
    found = figures(GaussianCloud.concatenate([cloud([0.0]), haze, floaters]), wall)
    assert found["thickness_cm"] < 0.01
    assert found["floaters_percent"] == pytest.approx(20.0, abs=0.1)


def test_a_triangle_without_area_spoils_nothing(tmp_path):
    corners = np.array(
        [[0, 0, 1], [2, 0, 1], [2, 2, 1], [0, 2, 1], [0, 1, 1.01], [1, 1, 1.01], [2, 1, 1.01]],
        np.float32,
    )
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.int32)
    path = tmp_path / "mesh.ply"
    write_mesh(path, TriangleMesh(corners, np.zeros((7, 3), np.float32), triangles))
    found = figures(cloud([0.0, 0.04]), path)
    assert found["thickness_p95_cm"] == pytest.approx(4.0, abs=0.1)
    assert found["floaters_percent"] == 0.0


def test_too_few_say_nothing(wall):
    assert figures(cloud([0.0], count=20), wall)["thickness_cm"] is None


def test_a_mesh_that_is_none_is_named(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_text("no mesh")
    with pytest.raises(FormatError, match=r"mesh\.ply"):
        wall_thickness(InMemoryScene(cloud([0.0])), path, np.eye(4))
