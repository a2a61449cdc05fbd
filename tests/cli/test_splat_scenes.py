"""export, render and view of splats as glTF and USD, as for a .ply."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelled_room import IDS
from test_export_formats import UTM, export
from test_finished_run_programs import one_line_of_error

from toolkit.io.images import read_rgb
from toolkit.io.splats import read_splats
from toolkit.runs.maps.labelled import taxonomy_of_file
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main

SUFFIXES = (".splats.glb", ".splats.gltf", ".usda", ".usdc", ".usdz")


def tree_of(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length])


def splats_at(run: Path, to: Path, *words: str) -> Path:
    if to.suffix.startswith(".usd"):
        pytest.importorskip("pxr.UsdVol", reason="needs usd-core: pip install 'semsplat[usd]'")
    return export(run, to, *words)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_map_is_the_same_after_export(labelled_run, tmp_path, suffix):
    before = read_splats(labelled_run / "map.ply")
    after = read_splats(splats_at(labelled_run, tmp_path / f"a{suffix}"))
    np.testing.assert_array_equal(after.means, before.means)
    np.testing.assert_array_equal(after.labels.levels, before.labels.levels)
    np.testing.assert_allclose(after.colours, before.colours, atol=1e-6)
    part = read_splats(splats_at(labelled_run, tmp_path / f"b{suffix}", "--keep", "table"))
    assert set(part.labels.label) == {IDS["table"]}


def test_splats_and_mesh_have_the_same_place(labelled_run, tmp_path):
    """A file .glb is a mesh, unless its name or --format says otherwise."""
    trimesh = pytest.importorskip("trimesh")
    run = shutil.copytree(labelled_run, tmp_path / "run")
    content = json.loads((run / "frames.json").read_text())
    (run / "frames.json").write_text(json.dumps(content | {"origin_m": UTM.tolist()}))
    splats = tree_of(export(run, tmp_path / "a.splats.glb"))
    assert tree_of(export(run, tmp_path / "b.glb", "--format", "splats")) == splats
    mesh_file = export(run, tmp_path / "c.glb", "--every", "1", "--voxel-m", "0.04")
    mesh = tree_of(mesh_file)
    assert "KHR_gaussian_splatting" not in mesh["extensionsUsed"]
    (node,) = splats["nodes"]
    assert node["extras"] == mesh["nodes"][0]["extras"]
    assert splats["asset"]["extras"]["classes"][str(IDS["table"])] == "table"
    assert splats["asset"]["extras"]["comments"] == ["origin_m 388096.000 3948996.000 57.000"]
    # The limits of the splats, placed by another reader, surround the vertices of the mesh.
    limits = splats["accessors"][0]
    corners = np.array(np.meshgrid(*zip(limits["min"], limits["max"], strict=True))).reshape(3, -1)
    placed = trimesh.transform_points(corners.T, np.array(node["matrix"]).reshape(4, 4).T)
    vertices = trimesh.load_scene(mesh_file).to_mesh().vertices
    assert (placed.min(axis=0) - 0.2 < vertices.min(axis=0)).all()
    assert (vertices.max(axis=0) < placed.max(axis=0) + 0.2).all()
    assert np.array_equal(read_splats(tmp_path / "b.glb").means, read_splats(run / "map.ply").means)


@pytest.mark.parametrize("suffix", [".splats.glb", ".usdz"])
def test_render_shows_the_same_images(labelled_run, tmp_path, suffix):
    images = []
    for file in (labelled_run / "map.ply", splats_at(labelled_run, tmp_path / f"a{suffix}")):
        out = tmp_path / f"out{file.suffix}"
        words = ["--out", str(out), "--image-size", "80", "60"]
        assert main(["render", str(file), *words]) == 0
        images.append(read_rgb(out / "colour_000000.png"))
    assert images[0].std() > 0.05
    assert np.abs(images[0] - images[1]).max() < 0.01


def test_what_has_no_splats_is_refused_in_one_line(labelled_run, tmp_path, capsys):
    (tmp_path / "mesh.glb").write_bytes(b"glTF\2\0\0\0\x0c\0\0\0")
    (tmp_path / "map.gltf").write_text('{"asset": {"version": "2.0"}}')
    for name, words in (("mesh.glb", "is not glTF"), ("map.gltf", "contains no splats")):
        error = one_line_of_error(capsys, "render", tmp_path / name, "--view", 0, 0, 0, 0, 0)
        assert str(tmp_path / name) in error and words in error


def test_splat_files_are_converted_in_chains_without_loss_of_labels(labelled_run, tmp_path):
    """A file of any tool, to any other format; what is not quantised stays as it is."""
    tree = Taxonomy.load(labelled_run / "taxonomy.yaml").to_json()
    before = read_splats(labelled_run / "map.ply")
    source = labelled_run / "map.ply"
    for name in ("a.splats.glb", "b.ply", "c.splats.gltf", "d.sog", "e.spz", "f.ply"):
        target = tmp_path / name
        assert main(["export", str(source), "--to", str(target)]) == 0
        assert taxonomy_of_file(target, read_splats(target)).to_json() == tree
        source = target
    exact = read_splats(tmp_path / "b.ply")
    np.testing.assert_array_equal(exact.means, before.means)
    np.testing.assert_array_equal(exact.labels.levels, before.labels.levels)
    last = read_splats(source)
    assert last.pixel_filter == before.pixel_filter
    assert np.bincount(last.labels.label).tolist() == np.bincount(before.labels.label).tolist()


@pytest.mark.parametrize("words", [["--to", "a.las"], ["--to", "a.ply", "--keep", "table"]])
def test_splat_files_are_converted_to_whole_splats_only(labelled_run, tmp_path, capsys, words):
    option, name, *others = words
    words = ["export", labelled_run / "map.ply", option, tmp_path / name, *others]
    assert "can be written as whole splats only" in one_line_of_error(capsys, *words)
    assert not list(tmp_path.iterdir())
