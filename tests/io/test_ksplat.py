"""`.ksplat` files, written here from the description of the format."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.io.splats import read_splats

BLOCK_M, RANGE, BUCKET = 5.0, 32767, 4
HALF = BLOCK_M / 2.0 / RANGE
LOW, HIGH = -0.5, 0.25


def values(count: int = 11, degree: int = 2) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    rotations = rng.normal(size=(count, 4))
    return {
        "position": rng.uniform(-2, 2, (count, 3)),
        "scale": rng.uniform(0.01, 0.1, (count, 3)),
        "rotation": rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        "rgba": rng.integers(1, 255, (count, 4)),
        "harmonics": rng.uniform(LOW, HIGH, (count, {0: 0, 1: 3, 2: 8}[degree], 3)),
    }


def section(splats: dict[str, np.ndarray], level: int) -> tuple[bytes, bytes]:
    """Header and content of a section with full buckets and two of the rest."""
    count, width = splats["harmonics"].shape[:2]
    full, rest = divmod(count, BUCKET)
    lengths = [1, rest - 1]
    bucket = np.repeat(np.arange(full + 2), [BUCKET] * full + lengths)
    centres = np.random.default_rng(1).uniform(-0.1, 0.1, (full + 2, 3)).astype("<f4")
    position, number = splats["position"].astype("<f4"), "<f2" if level else "<f4"
    buckets = b""
    if level:
        offsets = splats["position"] - centres[bucket]
        position = np.rint(offsets / HALF + RANGE).astype("<u2")
        buckets = struct.pack("<II", *lengths) + centres.tobytes()
    # Within a degree, all of red, then green, then blue.
    parts = [splats["harmonics"][:, :3], splats["harmonics"][:, 3:]]
    flat = [part.transpose(0, 2, 1).reshape(count, -1) for part in parts]
    harmonics = np.concatenate(flat, axis=1)
    if level == 2:
        harmonics = np.rint((harmonics - LOW) / (HIGH - LOW) * 255).astype("u1")
    else:
        harmonics = harmonics.astype(number)
    columns = [
        position,
        splats["scale"].astype(number),
        splats["rotation"].astype(number),
        splats["rgba"].astype("u1"),
        harmonics,
    ]
    rows = b"".join(b"".join(column[k].tobytes() for column in columns) for k in range(count))
    bucket_numbers = (BUCKET, full + 2, BLOCK_M, 12) if level else (0, 0, 0.0, 0)
    size = len(buckets) + len(rows)
    degree = {0: 0, 3: 1, 8: 2}[width]
    numbers = (RANGE, size, full, 2) if level else (0, size, 0, 0)
    header = struct.pack("<IIIIfHxxIIIIH", count, count, *bucket_numbers, *numbers, degree)
    return header.ljust(1024, b"\0"), buckets + rows


def ksplat(parts: list[dict[str, np.ndarray]], level: int) -> bytes:
    count = sum(len(part["position"]) for part in parts)
    numbers = (len(parts), len(parts), count, count, level)
    header = struct.pack("<BBxxIIIIHxx12xff", 0, 1, *numbers, LOW, HIGH).ljust(4096, b"\0")
    sections = [section(part, level) for part in parts]
    return header + b"".join(h for h, _ in sections) + b"".join(c for _, c in sections)


def write(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "map.ksplat"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_values_are_those_that_were_written(tmp_path, level, degree):
    written = values(degree=degree)
    read = read_splats(write(tmp_path, ksplat([written], level)))
    np.testing.assert_allclose(read.means, written["position"], atol=HALF if level else 1e-6)
    np.testing.assert_allclose(np.exp(read.ellipsoids.log_scales), written["scale"], rtol=1e-3)
    np.testing.assert_allclose(read.ellipsoids.rotations, written["rotation"], atol=1e-3)
    np.testing.assert_allclose(read.colours, written["rgba"][:, :3] / 255, atol=1e-6)
    opacities = 1.0 / (1.0 + np.exp(-read.opacity_logits))
    np.testing.assert_allclose(opacities, written["rgba"][:, 3] / 255, atol=1e-6)
    atol = {0: 1e-7, 1: 1e-3, 2: 2e-3}[level]
    np.testing.assert_allclose(read.ellipsoids.harmonics, written["harmonics"], atol=atol)


def test_sections_are_joined_with_the_harmonics_of_the_highest_degree(tmp_path):
    parts = [values(9, degree=0), values(6, degree=2)]
    read = read_splats(write(tmp_path, ksplat(parts, 1)))
    means = np.concatenate([part["position"] for part in parts])
    np.testing.assert_allclose(read.means, means, atol=HALF)
    assert not read.ellipsoids.harmonics[:9].any()
    np.testing.assert_allclose(read.ellipsoids.harmonics[9:], parts[1]["harmonics"], atol=1e-3)


def test_truncated_files_are_refused(tmp_path):
    content = ksplat([values(5), values(6)], 2)
    for length in (0, 9, 4095, 4096, 5000, 6144, 6150, len(content) - 1):
        path = write(tmp_path, content[:length])
        with pytest.raises(FormatError, match=r"map\.ksplat is truncated"):
            read_splats(path)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (1, b"\2", "it has version 0.2"),
        (20, b"\3", "level 3"),
        (16, struct.pack("<I", 10**9), "does not contain the 1000000000 splats"),
        (16, bytes(4), "does not contain the 0 splats"),
        (4, b"\xff\xff\xff\xff", "is truncated"),
        (4096, struct.pack("<II", 10**9, 10**9), "is truncated"),
        (4096 + 12, b"\1", "is truncated|do not hold all splats"),
        (4096 + 40, b"\3", "harmonics of degree 3"),
    ],
)
def test_damaged_headers_are_refused(tmp_path, place, value, words):
    content = bytearray(ksplat([values()], 1))
    content[place : place + len(value)] = value
    with pytest.raises(FormatError, match=words):
        read_splats(write(tmp_path, bytes(content)))


def test_rotations_of_length_zero_are_upright_and_nan_is_left_out(tmp_path, caplog):
    written = values()
    written["rotation"][0] = 0.0
    written["scale"][3] = np.nan
    read = read_splats(write(tmp_path, ksplat([written], 1)))
    assert read.ellipsoids.rotations[0].tolist() == [1, 0, 0, 0]
    assert len(read) == 10
    assert "1 of 11 splats are not finite" in caplog.text
