"""Splat files of unusual layout, damaged at any place, or made to exhaust memory."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.io.splat_examples import COUNT, ellipsoids, labels, one_line
from toolkit.base.errors import FormatError
from toolkit.io.label_files import label_file_of
from toolkit.io.splats import export_splats, read_splats

NAMES = [*"xyz", *(f"f_dc_{k}" for k in range(3)), "opacity"]
NAMES += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
ROW = np.array([1, 2, 3, 0.1, 0.2, 0.3, 1, -3, -4, -5, 1, 0, 0, 0], np.float64)
DTYPES = {"binary_little_endian": "<f4", "binary_big_endian": ">f4"}


def ply(form: str, count: int, names: list[str], row: np.ndarray, end: str = "\n") -> bytes:
    """A PLY of two equal rows that announces `count` of them."""
    lines = ["ply", f"format {form} 1.0", "comment Tür Å", f"element vertex {count}"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    body = " ".join(map(str, row)).encode() + b"\n"
    if form in DTYPES:
        body = row.astype(DTYPES[form]).tobytes()
    return end.join(lines).encode() + 2 * body


def assert_refused(path: Path, words: str) -> None:
    with pytest.raises(FormatError, match=words) as error:
        read_splats(path)
    assert one_line(error.value, path)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("form", [*DTYPES, "ascii"])
def test_all_formats_of_a_ply_are_read_or_refused_if_truncated(tmp_path, form, end):
    path = tmp_path / "map.ply"
    path.write_bytes(ply(form, 2, NAMES, ROW, end))
    splats = read_splats(path)
    np.testing.assert_allclose(splats.means, [[1, 2, 3]] * 2)
    np.testing.assert_allclose(splats.ellipsoids.log_scales, [[-3, -4, -5]] * 2, rtol=1e-6)
    for count in (3, 10**9):
        path.write_bytes(ply(form, count, NAMES, ROW, end))
        assert_refused(path, f"announces {count} rows of 'vertex'")


def test_columns_after_a_list_are_not_needed(tmp_path):
    """A mesh of splats, as some programs write it."""
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    content = ply("binary_little_endian", 2, NAMES, ROW).replace(b"end_header\n", faces.encode())
    (tmp_path / "map.ply").write_bytes(content + struct.pack("<B3i", 3, 0, 1, 0))
    assert len(read_splats(tmp_path / "map.ply")) == 2


@pytest.mark.parametrize("count", [1, 3, 10, 48])
def test_numbers_of_harmonics_of_no_degree_are_refused(tmp_path, count):
    path = tmp_path / "map.ply"
    names = [*NAMES, *(f"f_rest_{k}" for k in range(count))]
    path.write_bytes(ply("binary_little_endian", 2, names, np.append(ROW, np.zeros(count))))
    assert_refused(path, f"has {count} columns f_rest_N, instead of 0, 9, 24 or 45")


@pytest.mark.parametrize("missing", ["z", "f_dc_2", "opacity", "scale_2", "rot_3"])
def test_missing_columns_are_named(tmp_path, missing):
    path, keep = tmp_path / "map.ply", np.array(NAMES) != missing
    names = [name for name in NAMES if name != missing]
    path.write_bytes(ply("binary_little_endian", 2, names, ROW[keep]))
    assert_refused(path, "is not a splat file: it has no ")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"vertex 2", b"vertex -2"),
        (b"vertex 2", b"vertex 1" + 40 * b"0"),
        (b"float f_dc_0", b"flaot f_dc_0"),
        (b"float f_dc_0", b"float x"),
        (b"format binary_little_endian", b"format binary_middle_endian"),
        (b"element vertex 2\n", b""),
    ],
)
def test_damaged_headers_are_refused(tmp_path, old, new):
    path = tmp_path / "map.ply"
    path.write_bytes(ply("binary_little_endian", 2, NAMES, ROW).replace(old, new))
    assert_refused(path, "the PLY is damaged")


@pytest.mark.parametrize("length", [1e-30, 1e30])
def test_rotations_of_any_length_are_normalised(tmp_path, length):
    row = ROW.copy()
    row[-4:] = length * np.array([0.5, 0.5, -0.5, 0.5])
    (tmp_path / "map.ply").write_bytes(ply("binary_little_endian", 2, NAMES, row))
    rotations = read_splats(tmp_path / "map.ply").ellipsoids.rotations
    np.testing.assert_allclose(rotations, [[0.5, 0.5, -0.5, 0.5]] * 2, atol=1e-6)


def test_values_that_overflow_give_one_line_and_no_warning(tmp_path, recwarn):
    path, row = tmp_path / "map.ply", ROW.copy()
    row[NAMES.index("scale_1")] = 1000.0
    path.write_bytes(ply("ascii", 2, NAMES, row))
    assert_refused(path, "contains no splat with finite values")
    assert not recwarn.list


@pytest.mark.parametrize("suffix", [".SPZ", ".SOG", ".PLY", ".USDA", ".USDZ", ".GLB"])
def test_suffixes_may_be_in_capitals(tmp_path, suffix):
    if suffix.startswith(".USD"):
        pytest.importorskip("pxr.UsdVol")
    path = tmp_path / f"map{suffix.lower()}"
    export_splats(path, ellipsoids(1))
    assert len(read_splats(path.rename(tmp_path / f"MAP{suffix}"))) == COUNT


@pytest.mark.parametrize("damage", [b"", b"\xff" * 9])
def test_the_library_that_reads_spz_prints_nothing(tmp_path, capfd, damage):
    """It does to stdout, where `semsplat` writes its results."""
    path = tmp_path / "map.spz"
    export_splats(path, ellipsoids(1))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - len(damage)] + damage)
    if damage:
        assert_refused(path, "is damaged")
    else:
        assert len(read_splats(path)) == COUNT
    assert capfd.readouterr() == ("", "")


def spz(count: int, content: int) -> bytes:
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0)
    return gzip.compress(head + bytes(content), mtime=0)


def test_spz_files_are_not_unpacked_beyond_what_they_announce(tmp_path):
    path = tmp_path / "map.spz"
    path.write_bytes(spz(300, 10**7))
    assert_refused(path, "contains more than the 6000 bytes of 300 splats")
    path.write_bytes(spz(2 * 10**6, 4 * 10**7))
    assert_refused(path, "announces 2000000 splats in")


def test_spz_files_of_version_4_do_not_announce_more_than_they_hold(tmp_path):
    path = tmp_path / "map.spz"
    export_splats(path, ellipsoids(0))
    content = bytearray(path.read_bytes())
    streams, place = struct.unpack_from("<BI", content, 15)
    struct.pack_into("<I", content, 8, 10**9)
    for k in range(streams):
        packed, unpacked = struct.unpack_from("<QQ", content, place + 16 * k)
        struct.pack_into("<QQ", content, place + 16 * k, packed, unpacked // COUNT * 10**9)
    path.write_bytes(content)
    assert_refused(path, "announces 1000000000 splats in")


def bundle(path: Path, **changed: bytes) -> None:
    """Write a `.sog` again, compressed, with other members: a_b for a.b."""
    with zipfile.ZipFile(path) as old:
        files = {name: old.read(name) for name in old.namelist()}
    files |= {name.replace("_", "."): content for name, content in changed.items()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, content in files.items():
            new.writestr(name, content)


def test_sog_members_are_not_unpacked_without_limit(tmp_path):
    path = tmp_path / "map.sog"
    export_splats(path, ellipsoids(0))
    with zipfile.ZipFile(path) as old:
        meta = old.read("meta.json")
    bundle(path, meta_json=bytes(2**24).replace(b"\0", b" ") + meta)
    assert_refused(path, "'meta.json' would be unpacked to")
    picture = io.BytesIO()
    Image.new("L", (3000, 3000)).save(picture, "PNG")
    bundle(path, meta_json=meta, scales_webp=picture.getvalue())
    assert_refused(path, "scales.webp has 3000x3000 pixels")


def gltf(path: Path) -> dict:
    export_splats(path, ellipsoids(0))
    return json.loads(path.read_text(encoding="utf-8"))


def test_gltf_nodes_with_several_parents_do_not_multiply(tmp_path):
    """2^40 paths lead to the splats."""
    path = tmp_path / "map.gltf"
    tree = gltf(path)
    tree["nodes"] = [{"children": [k + 1, k + 1]} for k in range(40)] + tree["nodes"]
    path.write_text(json.dumps(tree))
    assert_refused(path, "a node has several parents")


@pytest.mark.parametrize("uri", ["%2Fetc%2Fpasswd", "../map.ply", "a/..%2F../map.ply"])
def test_gltf_buffers_lie_beside_the_file(tmp_path, uri):
    path = tmp_path / "map.gltf"
    tree = gltf(path)
    tree["buffers"][0]["uri"] = uri
    path.write_text(json.dumps(tree))
    assert_refused(path, "does not lie beside the file")


def test_damaged_usd_packages_are_refused(tmp_path):
    """OpenUSD crashes while it reads some of them."""
    pytest.importorskip("pxr.UsdVol")
    path = tmp_path / "map.usdz"
    export_splats(path, ellipsoids(0))
    content = path.read_bytes()
    for place in range(200, len(content) - 200, len(content) // 20):
        path.write_bytes(content[:place] + bytes([content[place] ^ 64]) + content[place + 1 :])
        assert_refused(path, r"is no USD file, or is damaged|cannot be read \(")


LAYER = """#usda 1.0
( defaultPrim = "a0" )
def "a0"
{{
    {}
}}
"""


def multiplied(levels: int) -> str:
    """Prims with ten children each, which refer to the prim of the next level."""
    prims = [
        "\n".join(
            [f'def "a{level}"', "{"]
            + [f'def "b{k}" ( references = </a{level + 1}> ) {{\n}}' for k in range(10)]
            + ["}"]
        )
        for level in range(levels)
    ]
    return "\n".join(["#usda 1.0", *prims, f'def "a{levels}" {{\n}}'])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (LAYER.format('def "b" ( references = @../other.usda@ ) {\n}'), "outside of its folder"),
        (LAYER.format('def "b" ( references = @/tmp/other.usda@ ) {\n}'), "outside of its folder"),
        ("#usda 1.0\n( subLayers = [@../other.usda@] )\n", "outside of its folder"),
        (multiplied(8), "makes more than 1,000,000 prims"),
        (LAYER.format('def "b" ( references = </a0> ) {\n}'), "refers to itself"),
        (LAYER.format('def "b" ( payload = @missing.usda@ ) {\n}'), r"missing\.usda: No such file"),
    ],
)
def test_usd_layers_are_checked_before_they_are_composed(tmp_path, text, fault):
    pytest.importorskip("pxr.UsdVol")
    (tmp_path / "other.usda").write_text(LAYER.format(""))
    path = tmp_path / "scene" / "map.usda"
    path.parent.mkdir()
    path.write_text(text)
    assert_refused(path, fault)


def test_usd_files_may_refer_to_others_beside_them(tmp_path):
    pytest.importorskip("pxr.UsdVol")
    inner = tmp_path / "parts" / "map.usdc"
    inner.parent.mkdir()
    export_splats(inner, ellipsoids(0))
    path = tmp_path / "scene.usda"
    path.write_text(LAYER.format('def "b" ( payload = @./parts/map.usdc@ ) {\n}'))
    assert len(read_splats(path)) == len(read_splats(inner))
    path.write_text("#usda 1.0\n( subLayers = [@./parts/map.usdc@ (offset = 1)] )\n")
    assert len(read_splats(path)) == len(read_splats(inner))


def test_label_files_that_are_damaged_anywhere_are_ignored(tmp_path, caplog):
    path = tmp_path / "map.splat"
    export_splats(path, ellipsoids(0), labels().columns(), taxonomy={"classes": ["chair"]})
    beside = label_file_of(path)
    content, ignored = beside.read_bytes(), 0
    for place in range(0, len(content), 13):
        beside.write_bytes(content[:place] + b"\xff\xff" + content[place + 2 :])
        ignored += read_splats(path).labels is None
    assert ignored > 0.3 * len(content) / 13
    assert "cannot be read and is ignored" in caplog.text
