"""`.spz` files: versions, axes, damaged files."""

import gzip
import struct

import numpy as np
import pytest

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io import splats

VERSIONS = (2, 3, 4)


def test_spz_of_version_2_is_small_and_isotropic(tmp_path, cloud):
    splats.export_splats(tmp_path / "map.spz", cloud, spz_version=2)
    content = gzip.decompress((tmp_path / "map.spz").read_bytes())
    assert content[:8] == b"NGSP\x02\0\0\0"
    assert len(content) == 16 + len(cloud) * (9 + 1 + 3 + 3 + 3)
    read = splats.read_splats(tmp_path / "map.spz")
    np.testing.assert_allclose(read.means, cloud.means.numpy(), atol=2e-4)
    np.testing.assert_allclose(read.log_radii, cloud.log_radii.numpy(), atol=0.04)
    np.testing.assert_allclose(read.colours, cloud.colours.numpy(), atol=0.01)
    opacities = 1.0 / (1.0 + np.exp(-read.opacity_logits))
    np.testing.assert_allclose(opacities, cloud.opacities.numpy(), atol=0.01)
    assert read.ellipsoids is None


@pytest.mark.parametrize("version", VERSIONS)
def test_axes_are_y_up_and_z_backward(tmp_path, ellipsoids, version):
    """Open3D, which has the reader of the format's authors, finds the same splats."""
    path = tmp_path / "map.spz"
    splats.export_splats(path, ellipsoids, spz_version=version)
    point = open3d().t.io.read_point_cloud(str(path)).point
    positions, rotations = (point[name].numpy().copy() for name in ("positions", "rot"))
    np.testing.assert_allclose(positions, ellipsoids.means.numpy() * [1, -1, -1], atol=2e-4)
    expected = ellipsoids.ellipsoids.rotations.numpy() * [1, 1, -1, -1]
    turns = np.abs((rotations * expected).sum(axis=1))
    np.testing.assert_allclose(turns, 1.0, atol=1e-3 if version == 2 else 1e-5)


def test_all_versions_contain_the_same_splats(tmp_path, ellipsoids):
    read = []
    for version in VERSIONS:
        path = tmp_path / f"{version}.spz"
        splats.export_splats(path, ellipsoids, spz_version=version)
        read.append(splats.read_splats(path))
        again = tmp_path / "again.spz"
        splats.export_splats(again, ellipsoids, spz_version=version)
        assert again.read_bytes() == path.read_bytes()
    for other in read[:2]:
        np.testing.assert_array_equal(other.means, read[2].means)
        np.testing.assert_array_equal(other.colours, read[2].colours)
        for name in ("log_scales", "harmonics"):
            values, expected = (getattr(s.ellipsoids, name) for s in (other, read[2]))
            np.testing.assert_allclose(values, expected, atol=1e-6)
    rotations = [splats_.ellipsoids.rotations for splats_ in read[1:]]
    np.testing.assert_allclose(*rotations, atol=2e-3)


def test_positions_further_than_2_km_are_refused(tmp_path, cloud):
    splats.export_splats(tmp_path / "map.spz", cloud)
    before = (tmp_path / "map.spz").read_bytes()
    far = cloud.transformed(np.array([[1, 0, 0, 3e3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    for version in VERSIONS:
        with pytest.raises(RunFolderError, match="within 2 km"):
            splats.export_splats(tmp_path / "map.spz", far, spz_version=version)
    assert (tmp_path / "map.spz").read_bytes() == before


@pytest.mark.parametrize("version", VERSIONS)
def test_truncated_files_are_refused(tmp_path, ellipsoids, version):
    path = tmp_path / "map.spz"
    splats.export_splats(path, ellipsoids, spz_version=version)
    content = path.read_bytes()
    for length in (*range(40), len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        with pytest.raises(FormatError, match=r"map\.spz .*write it again"):
            splats.read_splats(path)


def compressed(content: bytes) -> bytes:
    """As .gz without a time stamp: parameters of tests must be the same in every process."""
    return gzip.compress(content, mtime=0)


def head(version: int, count: int = 1, degree: int = 0) -> bytes:
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"NGSP\2\0\0\0" + bytes(24), "version 2 must be compressed"),
        (b"PK\3\4" + bytes(28), "is not a .spz file"),
        (compressed(b"PK\3\4" + bytes(28)), "not a .spz file"),
        (compressed(head(2, 10**9) + bytes(19)), "announces 1000000000 splats"),
        (compressed(head(2, 0)), "announces 0 splats"),
        (compressed(head(2, degree=4) + bytes(99)), "harmonics of degree 4"),
        (compressed(head(5) + bytes(99)), "version 5, but versions up to 4"),
        (head(5) + bytes(99), "version 5, but versions up to 4"),
        (head(4, 10**9) + struct.pack("<I12x", 32), "announces 1000000000 splats"),
    ],
)
def test_files_that_cannot_be_read_are_explained(tmp_path, content, words):
    (tmp_path / "map.spz").write_bytes(content)
    with pytest.raises(FormatError, match=words):
        splats.read_splats(tmp_path / "map.spz")
