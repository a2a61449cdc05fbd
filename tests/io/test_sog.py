"""SOG files: those of the description of the format, written here, and our own."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from toolkit.base.errors import FormatError
from toolkit.io.splats import export_splats, read_splats

N = 5
SCALES = np.linspace(-5, -2, 256)
COLOURS = np.linspace(-1.5, 1.5, 256)
HARMONICS = np.linspace(-0.4, 0.4, 256)


def webp(pixels: np.ndarray) -> bytes:
    """Rows of pixels in an image that is four wide."""
    full = np.zeros((8, 4), np.uint8)
    full[: len(pixels), : pixels.shape[1]] = pixels
    full[: len(pixels), pixels.shape[1] :] = 255
    return encoded(full.reshape(2, 4, 4))


def encoded(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


@pytest.fixture
def pixels() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    tagged = rng.integers(0, 256, (N, 4))
    tagged[:, :3] = rng.integers(90, 166, (N, 3))
    tagged[:, 3] = 252 + np.array([0, 1, 2, 3, 3])
    drawn = {name: rng.integers(0, 256, (N, 3)) for name in ("means_l", "means_u", "scales")}
    colours = rng.integers(0, 256, (N, 4))
    # The colour of a transparent pixel is that of a splat, too.
    colours[0, 3] = 0
    return drawn | {"quats": tagged, "sh0": colours}


def meta(version: int) -> dict[str, Any]:
    means = {"mins": [-1.0, -2.0, 0.0], "maxs": [1.0, 2.0, 3.0]}
    if version == 1:
        parts = {
            "means": means | {"shape": [N, 3]},
            "scales": {"mins": [-5.0, -4.0, -3.0], "maxs": [-2.0, -1.0, 0.0]},
            "sh0": {"mins": [-1.0, -1.0, -1.0, -4.0], "maxs": [1.0, 2.0, 3.0, 4.0]},
            "shN": {"mins": -0.5, "maxs": 0.5},
        }
    else:
        parts = {
            "version": 2,
            "count": N,
            "means": means,
            "scales": {"codebook": SCALES.tolist()},
            "sh0": {"codebook": COLOURS.tolist()},
            "shN": {"count": 2, "bands": 1, "codebook": HARMONICS.tolist()},
        }
    parts["quats"] = {}
    parts["means"]["files"] = ["means_l.webp", "means_u.webp"]
    for name in ("scales", "quats", "sh0"):
        parts[name]["files"] = [f"{name}.webp"]
    parts["shN"]["files"] = ["palette.webp", "labels.webp"]
    return parts


PALETTE = np.random.default_rng(1).integers(0, 256, (2, 3, 3))
LABELS = np.array([0, 1, 1, 0, 1])


def write(folder: Path, pixels: dict[str, np.ndarray], version: int) -> Path:
    palette = np.zeros((1, 64 * 3, 4), np.uint8)
    palette[0, :6, :3] = PALETTE.reshape(6, 3)
    files = {f"{name}.webp": webp(values) for name, values in pixels.items()}
    files["palette.webp"] = encoded(palette)
    files["labels.webp"] = webp(np.column_stack([LABELS, 0 * LABELS, 0 * LABELS]))
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (folder / "meta.json").write_text(json.dumps(meta(version)))
    return folder / "meta.json"


@pytest.mark.parametrize("version", [1, 2])
def test_values_are_those_of_the_description(tmp_path, pixels, version):
    read = read_splats(write(tmp_path, pixels, version))
    steps = pixels["means_l"] + 256 * pixels["means_u"]
    logarithms = np.array([-1, -2, 0]) + steps / 65535 * np.array([2, 4, 3])
    means = np.sign(logarithms) * (np.exp(np.abs(logarithms)) - 1)
    np.testing.assert_allclose(read.means, means, rtol=1e-5, atol=1e-6)
    rgb, alpha = pixels["sh0"][:, :3], pixels["sh0"][:, 3]
    if version == 2:
        scales, f_dc = SCALES[pixels["scales"]], COLOURS[rgb]
        opacities = alpha / 255
        palette = HARMONICS[PALETTE]
    else:
        scales = np.array([-5, -4, -3]) + pixels["scales"] / 255 * 3
        f_dc = -1 + rgb / 255 * np.array([2, 3, 4])
        opacities = 1 / (1 + np.exp(4 - alpha / 255 * 8))
        palette = -0.5 + PALETTE / 255
    np.testing.assert_allclose(read.ellipsoids.log_scales, scales, atol=1e-5)
    np.testing.assert_allclose(read.colours, 0.5 + 0.28209479 * f_dc, atol=1e-6)
    read_opacities = 1 / (1 + np.exp(-read.opacity_logits))
    np.testing.assert_allclose(read_opacities, opacities, atol=2e-6)
    np.testing.assert_allclose(read.ellipsoids.harmonics, palette[LABELS], atol=1e-6)
    rotations = read.ellipsoids.rotations
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-6)
    for rotation, (*others, tag) in zip(rotations, pixels["quats"], strict=True):
        expected = (np.array(others) / 255 * 2 - 1) / np.sqrt(2)
        np.testing.assert_allclose(np.delete(rotation, tag - 252), expected, atol=1e-6)


def test_a_bundle_is_the_same_as_its_files(tmp_path, pixels):
    path = write(tmp_path, pixels, 2)
    with zipfile.ZipFile(tmp_path / "map.sog", "w") as bundle:
        for file in sorted(tmp_path.glob("*.[wj]*")):
            bundle.write(file, file.name)
    unbundled, bundled = read_splats(path), read_splats(tmp_path / "map.sog")
    np.testing.assert_array_equal(bundled.means, unbundled.means)
    np.testing.assert_array_equal(bundled.ellipsoids.harmonics, unbundled.ellipsoids.harmonics)


def changed(path: Path, **values: Any) -> None:
    content = json.loads(path.read_text(encoding="utf-8"))
    for name, value in values.items():
        *parents, last = name.split("__")
        part = content
        for parent in parents:
            part = part[parent]
        part[last] = value
    path.write_text(json.dumps(content), encoding="utf-8")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"version": 3}, "version 3 is not 1 or 2"),
        ({"count": 0}, "announces 0 splats"),
        ({"count": 10**9}, "announces 1000000000 splats"),
        ({"count": "many"}, "is not as it must be"),
        ({"scales": None}, "is not as it must be"),
        ({"means__mins": [0.0]}, "is not as it must be"),
        ({"scales__codebook": [0.0]}, "is not as it must be"),
        ({"sh0__codebook": [0.0] * 300}, "300 values instead of 256"),
        ({"sh0__files": []}, "is not as it must be"),
        ({"sh0__files": ["../sh0.webp"]}, "not the name of a file beside it"),
        ({"sh0__files": ["/etc/passwd"]}, "not the name of a file beside it"),
        ({"sh0__files": ["nothing.webp"]}, "nothing.webp"),
        ({"sh0__files": ["meta.json"]}, "not a whole WebP or PNG image"),
        ({"shN__files": ["sh0.webp", "labels.webp"]}, "is 4 pixels wide"),
    ],
)
def test_damaged_files_are_refused(tmp_path, pixels, values, words):
    path = write(tmp_path, pixels, 2)
    changed(path, **values)
    with pytest.raises(FormatError, match=words) as error:
        read_splats(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_truncated_bundles_and_missing_images_are_refused(tmp_path, cloud):
    path = tmp_path / "map.sog"
    export_splats(path, cloud)
    content = path.read_bytes()
    with zipfile.ZipFile(path) as bundle:
        files = {name: bundle.read(name) for name in bundle.namelist()}
    for length in (0, 10, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FormatError, match=r"map\.sog cannot be read"):
            read_splats(path)
    for missing in files:
        with zipfile.ZipFile(path, "w") as bundle:
            for name in files.keys() - {missing}:
                bundle.writestr(name, files[name])
        with pytest.raises(FormatError, match=missing):
            read_splats(path)


def test_splats_that_are_not_numbers_are_left_out(tmp_path, pixels, caplog):
    path = write(tmp_path, pixels, 2)
    codebook = SCALES.tolist()
    codebook[int(pixels["scales"][2, 1])] = float("nan")
    changed(path, scales__codebook=codebook)
    assert len(read_splats(path)) < N
    assert "not finite" in caplog.text


def test_transparent_splats_keep_their_colours(tmp_path, cloud):
    """Encoders of images drop the colours of transparent pixels if they may."""
    path = tmp_path / "map.sog"
    export_splats(path, replace(cloud, opacity_logits=torch.full((len(cloud),), -20.0)))
    read = read_splats(path)
    nearest = np.linalg.norm(read.means[:, None] - cloud.means.numpy(), axis=2).argmin(axis=1)
    np.testing.assert_allclose(read.colours, cloud.colours.numpy()[nearest], atol=0.01)


def test_many_harmonics_share_a_palette(tmp_path, ellipsoids):
    """Images of the palette have 64 entries in a row, and are read back."""
    path = tmp_path / "map.sog"
    export_splats(path, ellipsoids)
    with zipfile.ZipFile(path) as bundle:
        content = json.loads(bundle.read("meta.json"))
        palette = Image.open(io.BytesIO(bundle.read("shN_centroids.webp")))
    assert content["shN"]["bands"] == 2
    assert palette.size == (64 * 8, 1)
    folder = tmp_path / "unpacked"
    shutil.unpack_archive(path, folder, "zip")
    np.testing.assert_array_equal(read_splats(folder / "meta.json").means, read_splats(path).means)
