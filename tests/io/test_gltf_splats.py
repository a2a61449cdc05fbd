"""Splats as glTF: round trips, the layout of KHR_gaussian_splatting, files of other programs."""

from __future__ import annotations

import base64
import json
import shutil
import struct
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splat_examples import (
    COUNT,
    NOTES,
    TILTED,
    TREE,
    assert_same_labels,
    assert_same_splats,
    ellipsoids,
    image_of,
    labels,
    one_line,
    spheres,
)

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry import se3
from toolkit.io.splat_placement import HALF_TURN
from toolkit.io.splats import (
    export_splat_scene,
    export_splats,
    is_splat_file,
    read_splats,
    write_splat_ply,
)
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, GaussianCloud

KHR = "KHR_gaussian_splatting"
SH0 = f"{KHR}:SH_DEGREE_0_COEF_0"


def parsed(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the buffer of a .glb, read without our reader."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def write_parsed(path: Path, tree: dict[str, Any], binary: bytes) -> Path:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    sizes = struct.pack("<II", 2, 28 + len(text) + len(binary))
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    data = struct.pack("<I", len(binary)) + b"BIN\0" + binary
    path.write_bytes(b"glTF" + sizes + chunks + data)
    return path


def attribute(path: Path, name: str) -> np.ndarray:
    tree, binary = parsed(path)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][name]]
    view = tree["bufferViews"][accessor["bufferView"]]
    dtype = {5122: "<i2", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]]
    rows = np.frombuffer(binary, np.uint8, view["byteLength"], view["byteOffset"])
    rows = rows.reshape(accessor["count"], -1)
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]] * np.dtype(dtype).itemsize
    return np.ascontiguousarray(rows[:, :width]).view(dtype)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize("placement", [HALF_TURN, TILTED], ids=["level", "tilted"])
@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
def test_a_map_with_labels_is_read_as_it_was_written(tmp_path, suffix, placement, degree):
    cloud = spheres() if degree is None else ellipsoids(degree)
    path, scene = tmp_path / f"map{suffix}", replace(NOTES, T_scene_map=placement)
    export_splat_scene(path, cloud, labels().columns(), scene)
    assert is_splat_file(path)
    read = read_splats(path)
    assert_same_splats(read, cloud)
    assert_same_labels(read.labels, labels())
    assert json.dumps(read.taxonomy) == json.dumps(TREE)  # in the same order
    content = path.read_bytes()
    export_splat_scene(path, cloud, labels().columns(), scene)
    assert path.read_bytes() == content


def test_the_layout_is_that_of_the_extension(tmp_path):
    """One splat with axes of 0.1, 0.2 and 0.3 m, the second of them forward, seen as green."""
    cloud = ellipsoids(1).select(torch.tensor([0]))
    turn = torch.tensor([[0.5**0.5, 0.5**0.5, 0.0, 0.0]])
    shapes = replace(
        cloud.ellipsoids,
        log_scales=torch.tensor([[0.1, 0.2, 0.3]]).log(),
        rotations=2.0 * turn,
        harmonics=torch.tensor([[[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]]),
    )
    one = replace(
        cloud,
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        opacity_logits=torch.tensor([0.75]).logit(),
        colours=torch.tensor([[0.0, 0.5, 1.5]]),
        ellipsoids=shapes,
        low_pass=LOW_PASS_3DGS,
    )
    export_splats(tmp_path / "a.glb", one, {"label": np.array([-3])}, ["a comment"])
    tree, _ = parsed(tmp_path / "a.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR]["kernel"] == "ellipse"
    assert primitive["extensions"][KHR]["colorSpace"] == "srgb_rec709_display"
    assert tree["extensionsUsed"] == [KHR]
    assert tree["asset"]["extras"] == {"comments": ["a comment"]}
    assert "matrix" not in tree["nodes"][0]
    expected = {
        "POSITION": [1, -2, -3],  # y up, z backward
        f"{KHR}:ROTATION": [0.5**0.5, 0, 0, 0.5**0.5],  # xyzw, of length 1
        f"{KHR}:SCALE": [0.1, 0.2, 0.3],
        f"{KHR}:OPACITY": [0.75],
        SH0: [-0.5 / 0.28209479, 0, 1.0 / 0.28209479],
        f"{KHR}:SH_DEGREE_1_COEF_0": [-0.1, 0, 0],  # y is reversed
        f"{KHR}:SH_DEGREE_1_COEF_1": [0, -0.2, 0],
        f"{KHR}:SH_DEGREE_1_COEF_2": [0, 0, 0.3],
        "COLOR_0": [0, 14027, 65535, 49151],  # linear, at most 1
        "_LABEL": [-3],
    }
    assert set(primitive["attributes"]) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(attribute(tmp_path / "a.glb", name)[0], value, atol=1e-6)


def test_a_file_of_another_program_is_turned_with_its_node(tmp_path):
    """Also its harmonics: it looks like the map that was moved in memory."""
    cloud = ellipsoids(3)
    export_splats(tmp_path / "a.glb", cloud)
    tree, binary = parsed(tmp_path / "a.glb")
    T = se3.exp(np.array([0.1, -0.2, 0.3, 0.5, -0.9, 0.4]))
    del tree["nodes"][0]["extras"]
    x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
    tree["nodes"] += [{"children": [0], "rotation": [x, y, z, w], "translation": T[:3, 3].tolist()}]
    tree["scenes"][0]["nodes"] = [1]
    read = read_cloud(write_parsed(tmp_path / "b.glb", tree, binary))
    moved = cloud.transformed(HALF_TURN @ T @ HALF_TURN)
    torch.testing.assert_close(read.means, moved.means)
    assert float((image_of(read) - image_of(moved)).abs().max()) < 1e-4
    assert float((image_of(read) - image_of(cloud)).abs().max()) > 0.1
    tree["nodes"][1]["scale"] = [2.0, 2.0, 2.0]
    tree["scenes"] = []
    scaled = read_cloud(write_parsed(tmp_path / "c.glb", tree, binary))
    log_scales = moved.ellipsoids.log_scales + float(np.log(2.0))
    torch.testing.assert_close(scaled.ellipsoids.log_scales, log_scales)


def foreign(columns: dict[str, np.ndarray], **description: str) -> tuple[dict[str, Any], bytes]:
    """A tree and a buffer as another program writes them: integers, interleaved."""
    count = len(columns["POSITION"])
    fields = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()]
    dtype = np.dtype(fields, align=True)
    rows = np.zeros(count, dtype)
    for name, column in columns.items():
        rows[name] = column
    codes = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "float32": 5126}
    stride = -(-dtype.itemsize // 4) * 4
    binary = b"".join(row.tobytes().ljust(stride, b"\0") for row in rows)
    accessors = [
        {
            "bufferView": 0,
            "byteOffset": dtype.fields[name][1],
            "componentType": codes[column.dtype.name],
            "normalized": column.dtype.kind != "f" and not name.endswith("SCALE"),
            "count": count,
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]],
        }
        for name, column in columns.items()
    ]
    primitive = {
        "mode": 0,
        "attributes": {name: k for k, name in enumerate(columns)},
        "extensions": {KHR: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    primitive["extensions"][KHR].update(description)
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [KHR],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": len(binary), "byteStride": stride}],
        "buffers": [{"byteLength": len(binary)}],
    }
    return tree, binary


def two_splats(rotation: Any, scale: Any, opacity: Any) -> dict[str, np.ndarray]:
    return {
        "POSITION": np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        f"{KHR}:ROTATION": np.array([[0, 0, 0, 1], [1, 0, 0, 0]]) * rotation(1),
        f"{KHR}:SCALE": np.array([[1, 2, 3], [4, 5, 6]]).astype(scale),
        f"{KHR}:OPACITY": np.array([[0], [1]]) * opacity(1),
        SH0: np.zeros((2, 3), np.float32),
    }


def full(dtype: type) -> Callable[[int], np.ndarray]:
    return lambda _: np.array(np.iinfo(dtype).max, dtype)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("store", ["inside", "beside", "embedded"])
def test_integers_and_all_places_of_buffers_are_read(tmp_path, bits, store):
    signed, unsigned = getattr(np, f"int{bits}"), getattr(np, f"uint{bits}")
    columns = two_splats(full(signed), unsigned, full(unsigned))
    columns = {
        name: c if c.dtype == np.float32 else c.astype(signed if "ROT" in name else unsigned)
        for name, c in columns.items()
    }
    tree, binary = foreign(columns)
    path = tmp_path / "a.gltf"
    if store == "inside":
        path = write_parsed(tmp_path / "a.glb", tree, binary)
    else:
        uri = "my%20data.bin"
        (tmp_path / "my data.bin").write_bytes(binary)
        if store == "embedded":
            uri = "data:application/gltf-buffer;base64," + base64.b64encode(binary).decode()
        tree["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(tree))
    read = read_splats(path)
    np.testing.assert_array_equal(read.means, [[1, -2, -3], [4, -5, -6]])
    scales = np.exp(read.ellipsoids.log_scales)
    np.testing.assert_allclose(scales, [[1, 2, 3], [4, 5, 6]], rtol=1e-6)
    np.testing.assert_allclose(read.ellipsoids.rotations, [[1, 0, 0, 0], [0, 1, 0, 0]], atol=1e-6)
    assert read.opacity_logits[0] < -16 and 16 < read.opacity_logits[1] < np.inf
    np.testing.assert_allclose(read.colours, 0.5)


def test_primitives_of_different_degrees_are_joined(tmp_path):
    export_splats(tmp_path / "a.glb", ellipsoids(2))
    tree, binary = parsed(tmp_path / "a.glb")
    (full_,) = tree["meshes"][0]["primitives"]
    plain = {k: v for k, v in full_["attributes"].items() if "_DEGREE_" not in k or k == SH0}
    plain["_FEATURE"] = plain[f"{KHR}:OPACITY"]
    tree["meshes"][0]["primitives"] += [{**full_, "attributes": plain}]
    read = read_splats(write_parsed(tmp_path / "b.glb", tree, binary))
    assert read.ellipsoids.harmonics.shape == (2 * COUNT, 8, 3)
    assert not read.ellipsoids.harmonics[COUNT:].any() and not read.extra
    np.testing.assert_array_equal(read.means[COUNT:], read.means[:COUNT])


def test_linear_colours_become_srgb(tmp_path, caplog):
    columns = two_splats(np.float32, np.float32, np.float32)
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    columns[SH0] = ((np.array([[0.214, 0.0, 1.0]] * 2) - 0.5) / 0.28209479).astype(np.float32)
    tree, binary = foreign(columns, colorSpace="lin_rec709_display")
    read = read_splats(write_parsed(tmp_path / "a.glb", tree, binary))
    np.testing.assert_allclose(read.colours, [[0.5, 0.0, 1.0]] * 2, atol=1e-3)
    assert "are converted to sRGB" in caplog.text


def test_splats_that_are_not_valid_are_left_out(tmp_path, caplog):
    columns = two_splats(np.float32, np.float32, np.float32)
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    columns[f"{KHR}:SCALE"][0, 1] = -1.0
    columns[f"{KHR}:ROTATION"][1] = 0.0
    tree, binary = foreign(columns)
    read = read_splats(write_parsed(tmp_path / "a.glb", tree, binary))
    assert len(read) == 1 and "1 of 2 splats are not finite" in caplog.text
    np.testing.assert_array_equal(read.ellipsoids.rotations, [[1, 0, 0, 0]])


def test_truncated_files_are_refused(tmp_path):
    export_splats(tmp_path / "a.glb", spheres().select(torch.arange(2)))
    export_splats(tmp_path / "a.gltf", spheres().select(torch.arange(2)))
    for name in ("a.glb", "a.gltf"):
        content, cut = (tmp_path / name).read_bytes(), tmp_path / f"cut{Path(name).suffix}"
        for length in (*range(0, len(content) - 1, 13), len(content) - 1):
            cut.write_bytes(content[:length])
            with pytest.raises(FormatError) as error:
                read_splats(cut)
            assert one_line(error.value, cut), error.value


def _set(tree: dict[str, Any], *keys: Any) -> None:
    *path, last, value = keys
    for key in path:
        tree = tree[key]
    tree[last] = value


PRIMITIVE = ("meshes", 0, "primitives", 0)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (("accessors", 0, "count", 10**9), "is truncated: accessor 0 announces 1000000000"),
        (("accessors", 0, "count", 0), "announces 0 elements"),
        (("accessors", 0, "count", -1), "is damaged"),
        (("accessors", 3, "count", 1), r"SCALE has shape \[1, 3\], instead of \[40, 3\]"),
        (("accessors", 0, "sparse", {}), "sparse or compressed"),
        (("accessors", 0, "componentType", 1), "is damaged"),
        (("bufferViews", 0, "byteOffset", 10**12), "is truncated"),
        (("bufferViews", 0, "byteStride", 10**12), "is truncated"),
        (("asset", "version", "1.0"), "is glTF 1.0; write it as glTF 2.0"),
        (("extensionsRequired", ["EXT_meshopt_compression"]), "requires .* EXT_meshopt_comp"),
        ((*PRIMITIVE, "attributes", f"{KHR}:SCALE", -1), "is damaged"),
        ((*PRIMITIVE, "attributes", {"POSITION": 0}), "no attribute KHR_gaussian_splatting:SCALE"),
        ((*PRIMITIVE, "mode", 4), "must be points"),
        ((*PRIMITIVE, "extensions", {}), "contains no splats"),
        (("nodes", 0, "children", [0]), "is damaged"),
        (("nodes", 0, "scale", [1, 1, -1]), "is mirrored, skewed or scaled differently"),
        (("nodes", 0, "scale", [1, 2, 1]), "is mirrored, skewed or scaled differently"),
        (("nodes", 0, "rotation", [0, 0, 0, 0]), "is damaged"),
        (("nodes", []), "is damaged"),
        (("buffers", 0, "byteLength", "x"), None),
    ],
)
def test_damaged_files_are_explained_in_one_line(tmp_path, keys, words):
    export_splats(tmp_path / "a.glb", spheres())
    tree, binary = parsed(tmp_path / "a.glb")
    _set(tree, *keys)
    path = write_parsed(tmp_path / "b.glb", tree, binary)
    if words is None:  # the length of the chunk counts
        assert len(read_splats(path)) == COUNT
        return
    with pytest.raises(FormatError, match=words) as error:
        read_splats(path)
    assert one_line(error.value, path)


@pytest.mark.parametrize("uri", ["gone.bin", "/etc/hostname", "https://host/a.bin", "data:,***"])
def test_buffers_that_are_not_beside_the_file_are_refused(tmp_path, uri):
    columns = two_splats(np.float32, np.float32, np.float32)
    tree, _ = foreign({name: column.astype(np.float32) for name, column in columns.items()})
    tree["buffers"][0]["uri"] = uri
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(FormatError) as error:
        read_splats(tmp_path / "a.gltf")
    assert one_line(error.value, tmp_path / "a.gltf")


@pytest.mark.parametrize("extras", [3, {"comments": 3, "taxonomy": ["chair"]}])
def test_extras_of_other_programs_are_no_notes(tmp_path, extras):
    export_splats(tmp_path / "a.glb", spheres())
    tree, binary = parsed(tmp_path / "a.glb")
    tree["asset"]["extras"] = extras
    read = read_splats(write_parsed(tmp_path / "b.glb", tree, binary))
    assert read.comments == () and read.taxonomy is None


def test_columns_that_gltf_cannot_hold_are_refused(tmp_path):
    large = {"label": np.full(COUNT, 70_000)}
    with pytest.raises(RunFolderError, match="column label has integers of more than 16 bits"):
        export_splats(tmp_path / "a.glb", spheres(), large)
    with pytest.raises(RunFolderError, match="no Gaussian"):
        export_splats(tmp_path / "a.glb", GaussianCloud.empty())
    assert list(tmp_path.iterdir()) == []


def test_gltf_and_ply_look_the_same(tmp_path):
    cloud = ellipsoids(3)
    write_splat_ply(tmp_path / "a.ply", cloud)
    export_splats(tmp_path / "a.glb", cloud)
    images = [image_of(read_cloud(tmp_path / name)) for name in ("a.ply", "a.glb")]
    assert float(images[0].max()) > 0.1
    torch.testing.assert_close(images[0], images[1], atol=1e-5, rtol=0)


VALIDATE = """
const validator = require("gltf-validator");
const bytes = new Uint8Array(require("fs").readFileSync(process.argv[1]));
validator.validateBytes(bytes, {maxIssues: 0}).then(r => console.log(JSON.stringify(r.issues)));
"""
NODE_MODULES = Path(__file__).parents[2] / ".stamps/node/node_modules"


def issues(path: Path) -> list[dict[str, Any]]:
    """What the validator of the Khronos Group finds."""
    if shutil.which("node") is None or not (NODE_MODULES / "gltf-validator").is_dir():
        pytest.skip("needs node and gltf-validator, which `make test` installs if npm exists")
    command = ["node", "-e", VALIDATE, str(path)]
    # The package is found in the current folder.
    done = subprocess.run(command, cwd=NODE_MODULES.parent, capture_output=True, check=True)
    return json.loads(done.stdout)["messages"]


def test_the_validator_of_khronos_accepts_the_file(tmp_path):
    """Version 2.0.0-dev.3.10 knows no attributes of extensions, so it also gets them renamed."""
    path = tmp_path / "a.glb"
    export_splat_scene(path, ellipsoids(3), labels().columns(), replace(NOTES, T_scene_map=TILTED))
    for issue in issues(path):
        if issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE":
            assert f"/{KHR}:" in issue["pointer"]
        else:
            assert issue["code"] == "UNSUPPORTED_EXTENSION", issue
    tree, binary = parsed(path)
    (primitive,) = tree["meshes"][0]["primitives"]
    renamed = {n.replace(f"{KHR}:", "_"): k for n, k in primitive["attributes"].items()}
    primitive["attributes"] = renamed
    found = issues(write_parsed(tmp_path / "b.glb", tree, binary))
    assert [issue["code"] for issue in found] == ["UNSUPPORTED_EXTENSION"]
