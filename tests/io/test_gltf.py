"""Meshes as glTF: names, extras and colours as they were given."""

import json
import sys

import numpy as np
import pytest

from toolkit.base.errors import DependencyError
from toolkit.io.gltf import MeshPart, write_gltf
from toolkit.io.meshes import TriangleMesh

TRIANGLE = TriangleMesh(
    np.eye(3), np.array([[0.0, 0.05, 1.0]] * 3), np.array([[0, 1, 2]], dtype=np.int32)
)


def test_parts_of_equal_names_and_dark_colours_are_kept(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    parts = [MeshPart("map", TRIANGLE, {"class_id": k}) for k in (1, 2)]
    write_gltf(tmp_path / "a.gltf", parts, np.diag([1.0, -1.0, -1.0, 1.0]), {"metric": True})
    root, *nodes = json.loads((tmp_path / "a.gltf").read_text())["nodes"]
    assert (root["extras"], root["children"]) == ({"metric": True}, [1, 2])
    assert [(n["name"], n["extras"]) for n in nodes] == [("map", p.extras) for p in parts]
    scene = trimesh.load(tmp_path / "a.gltf")
    assert len(scene.geometry) == 2
    for mesh in scene.geometry.values():
        colours = mesh.visual.vertex_attributes["color"]
        # sRGB 0.05 is linear 0.0039, one step of 8 bits.
        np.testing.assert_array_equal(colours, [[0, 258, 65535, 65535]] * 3)


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(DependencyError, match=r"needs trimesh: pip install 'semsplat\[exports\]'"):
        write_gltf(tmp_path / "a.glb", [MeshPart("a", TRIANGLE)], np.eye(4), {})
