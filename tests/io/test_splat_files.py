"""Splat files: round trips, the layout of viewers, damaged files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.base.errors import DatasetError, FormatError, RunFolderError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io import splats
from toolkit.io.suffixes import SCENE_SUFFIXES, SPLAT_SUFFIXES
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS, PIXEL_FILTER, GaussianCloud
from toolkit.splatting.rendering import render

# Tests of glTF and USD are in their own files.
WRITTEN = (*(s for s in SPLAT_SUFFIXES if s not in SCENE_SUFFIXES), ".compressed.ply")


def test_ply_round_trip_with_labels(tmp_path, cloud):
    extra = {"label": np.arange(50), "label_l0": np.arange(50) % 3, "confidence": np.ones(50) / 3}
    splats.write_splat_ply(tmp_path / "map.ply", cloud, extra)
    read = splats.read_splats(tmp_path / "map.ply")
    np.testing.assert_array_equal(read.means, cloud.means.numpy())
    np.testing.assert_allclose(read.log_radii, cloud.log_radii.numpy(), atol=1e-6)
    np.testing.assert_array_equal(read.opacity_logits, cloud.opacity_logits.numpy())
    np.testing.assert_allclose(read.colours, cloud.colours.numpy(), atol=1e-6)
    np.testing.assert_array_equal(read.extra["label"], np.arange(50))
    assert read.extra["label_l0"].dtype == np.int32
    np.testing.assert_allclose(read.extra["confidence"], 1 / 3)


def test_ply_properties_follow_the_convention_of_viewers(tmp_path):
    one = GaussianCloud.from_values(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        radii_m=torch.tensor([0.5]),
        opacities=torch.tensor([0.9]),
        colours=torch.tensor([[1.0, 0.5, 0.0]]),
    )
    splats.write_splat_ply(tmp_path / "map.ply", one)
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    names = [
        line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property")
    ]
    values = dict(zip(names, np.frombuffer(body, np.float32), strict=True))
    expected = {
        "x": 1,
        "y": 2,
        "z": 3,
        **{f"f_dc_{i}": (c - 0.5) / 0.28209479 for i, c in enumerate((1.0, 0.5, 0.0))},
        "opacity": np.log(0.9 / 0.1),
        **{f"scale_{i}": np.log(0.5) for i in range(3)},
        "rot_0": 1,
        "rot_1": 0,
        "rot_2": 0,
        "rot_3": 0,
    }
    assert set(values) == set(expected)
    for name, value in expected.items():
        assert values[name] == pytest.approx(value, abs=1e-5), name


@pytest.mark.parametrize("suffix", WRITTEN)
def test_only_dot_splat_clamps_colours(tmp_path, suffix):
    colours = torch.tensor([[1.2, 0.5, -0.1]])
    one = GaussianCloud.from_values(
        torch.zeros(1, 3), torch.full((1,), 0.5), torch.full((1,), 0.9), colours
    )
    splats.export_splats(tmp_path / f"map{suffix}", one)
    read = splats.read_splats(tmp_path / f"map{suffix}").colours
    expected = colours.clamp(0.0, 1.0) if suffix == ".splat" else colours
    np.testing.assert_allclose(read, expected, atol=1e-6 if suffix == ".ply" else 0.01)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_exports_are_reproducible_and_preserve_the_map(tmp_path, cloud, suffix):
    for name in ("a", "b"):
        splats.export_splats(tmp_path / f"{name}{suffix}", cloud)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    read = splats.read_splats(tmp_path / f"a{suffix}")
    nearest = np.abs(read.means[:, None] - cloud.means.numpy()[None]).sum(axis=2)
    matched = nearest.argmin(axis=1)
    assert sorted(matched) == list(range(50))
    assert nearest.min(axis=1).max() < (8e-3 if suffix == ".compressed.ply" else 1e-3)
    np.testing.assert_allclose(read.colours, cloud.colours.numpy()[matched], atol=0.02)
    np.testing.assert_allclose(read.log_radii, cloud.log_radii.numpy()[matched], atol=0.05)


@pytest.mark.parametrize("suffix", WRITTEN[1:])
def test_values_that_are_not_numbers_are_not_quantised(tmp_path, cloud, suffix):
    path = tmp_path / f"map{suffix}"
    splats.export_splats(path, cloud)
    before = path.read_bytes()
    means = cloud.means.clone()
    means[3, 1] = float("nan")
    with pytest.raises(RunFolderError, match="Gaussians that are not finite"):
        splats.export_splats(path, replace(cloud, means=means))
    assert path.read_bytes() == before


@pytest.mark.parametrize("length", [0, 31, 33])
def test_truncated_dot_splat_raises(tmp_path, length):
    (tmp_path / "map.splat").write_bytes(bytes(length))
    with pytest.raises(FormatError, match=r"map\.splat is truncated, or not a \.splat file"):
        splats.read_splats(tmp_path / "map.splat")


def test_truncated_ply_raises(tmp_path, cloud):
    splats.write_splat_ply(tmp_path / "map.ply", cloud)
    content = (tmp_path / "map.ply").read_bytes()
    (tmp_path / "map.ply").write_bytes(content[:-9])
    with pytest.raises(FormatError, match=r"map\.ply is truncated"):
        splats.read_splats(tmp_path / "map.ply")


def test_other_point_clouds_and_missing_files_raise(tmp_path):
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(FormatError, match="not a splat file"):
        splats.read_splats(tmp_path / "cloud.ply")
    with pytest.raises(DatasetError, match="does not exist"):
        splats.read_splats(tmp_path / "nowhere.ply")


def test_empty_map_and_columns_of_wrong_length_raise(tmp_path, cloud):
    with pytest.raises(RunFolderError, match="no Gaussian"):
        splats.write_splat_ply(tmp_path / "map.ply", GaussianCloud.empty())
    with pytest.raises(ValueError, match=r"label must have shape \[50\]"):
        splats.write_splat_ply(tmp_path / "map.ply", cloud, {"label": np.zeros(3, int)})
    assert list(tmp_path.iterdir()) == []


def test_foreign_formats_are_named(tmp_path):
    for name in ("map.lcc", "map.splatv", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(FormatError, match=r"is not supported; convert it to \.ply"):
            splats.is_splat_file(tmp_path / name)
    (tmp_path / "run.ply").mkdir()
    assert not splats.is_splat_file(tmp_path / "run.ply")
    assert not splats.is_splat_file(tmp_path / "run")
    for name in ("MAP.PLY", "map.ksplat", "map.sog", "meta.json"):
        assert splats.is_splat_file(tmp_path / name)
    with pytest.raises(ValueError, match=r"must end in one of \.ply, \.splat, \.spz, \.sog"):
        splats.export_splats(tmp_path / "map.ksplat", GaussianCloud.empty())


def assert_same_ellipsoids(read: GaussianCloud, written: GaussianCloud, atol: float) -> None:
    assert read.ellipsoids is not None and written.ellipsoids is not None
    assert read.low_pass == LOW_PASS_3DGS
    torch.testing.assert_close(
        read.ellipsoids.log_scales, written.ellipsoids.log_scales, atol=atol, rtol=0
    )
    turns = (read.ellipsoids.rotations * written.ellipsoids.rotations).sum(dim=1).abs()
    assert float(turns.min()) > 1.0 - atol


def test_ellipsoids_and_harmonics_survive_in_a_ply(tmp_path, ellipsoids):
    splats.write_splat_ply(tmp_path / "map.ply", ellipsoids)
    header = (tmp_path / "map.ply").read_bytes().partition(b"end_header")[0]
    assert header.count(b"f_rest_") == 24
    read = read_cloud(tmp_path / "map.ply")
    assert_same_ellipsoids(read, ellipsoids, 1e-5)
    torch.testing.assert_close(read.ellipsoids.harmonics, ellipsoids.ellipsoids.harmonics)
    torch.testing.assert_close(read.log_radii, ellipsoids.log_radii)


@pytest.mark.parametrize("suffix", [".splat", ".spz", ".sog", ".compressed.ply"])
def test_ellipsoids_survive_in_formats_of_bytes(tmp_path, ellipsoids, suffix):
    """Formats sort splats; `.splat` has no harmonics, and those of the others are rounded."""
    splats.export_splats(tmp_path / f"map{suffix}", ellipsoids)
    read = read_cloud(tmp_path / f"map{suffix}")
    read = read.select(torch.cdist(ellipsoids.means, read.means).argmin(dim=1))
    assert_same_ellipsoids(read, ellipsoids, 0.05)
    if suffix == ".splat":
        assert read.ellipsoids.harmonics.shape[1] == 0
    else:
        written = ellipsoids.ellipsoids.harmonics
        atol = 0.07 if suffix == ".spz" else 0.02
        torch.testing.assert_close(read.ellipsoids.harmonics, written, atol=atol, rtol=0)


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply"])
def test_files_of_one_map_look_the_same(tmp_path, ellipsoids, suffix):
    """Also from the side, so the axes of harmonics and rotations are right."""
    camera = Camera(40.0, 40.0, 15.5, 15.5, 32, 32)
    T_camera_map = se3.exp(np.array([0.2, 0.1, 2.0, 0.3, 0.8, -0.4]))
    images = []
    for name in ("map.ply", f"other{suffix}"):
        splats.export_splats(tmp_path / name, ellipsoids)
        images.append(render(read_cloud(tmp_path / name), camera, T_camera_map).colour)
    assert float(images[0].max()) > 0.1
    assert float((images[0] - images[1]).abs().max()) < 0.05


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("low_pass", [PIXEL_FILTER, LOW_PASS_3DGS])
def test_all_but_dot_splat_say_how_ellipsoids_are_filtered(tmp_path, ellipsoids, suffix, low_pass):
    splats.export_splats(tmp_path / f"map{suffix}", replace(ellipsoids, low_pass=low_pass))
    expected = LOW_PASS_3DGS if suffix == ".splat" else low_pass
    assert read_cloud(tmp_path / f"map{suffix}").low_pass == expected


@pytest.mark.parametrize("low_pass", [PIXEL_FILTER, LOW_PASS_3DGS])
def test_a_ply_says_how_its_ellipsoids_are_filtered(tmp_path, ellipsoids, low_pass):
    """Without a word, they are those of another tool."""
    splats.write_splat_ply(tmp_path / "map.ply", replace(ellipsoids, low_pass=low_pass))
    header = (tmp_path / "map.ply").read_bytes().partition(b"end_header")[0]
    assert (b"comment pixel_filter" in header) == (low_pass == PIXEL_FILTER)
    assert read_cloud(tmp_path / "map.ply").low_pass == low_pass
    splats.write_splat_ply(tmp_path / "again.ply", splats.read_splats(tmp_path / "map.ply"))
    assert read_cloud(tmp_path / "again.ply").low_pass == low_pass


def test_rotations_of_length_zero_are_upright(tmp_path, ellipsoids):
    splats.write_splat_ply(tmp_path / "map.ply", ellipsoids)
    header, end, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if b"property" in line]
    rows = np.frombuffer(body, np.float32).reshape(len(ellipsoids), len(names)).copy()
    first = names.index("rot_0")
    rows[0, first : first + 4] = 0.0
    (tmp_path / "map.ply").write_bytes(header + end + rows.tobytes())
    rotations = read_cloud(tmp_path / "map.ply").ellipsoids.rotations
    assert rotations[0].tolist() == [1, 0, 0, 0]


def changed(path, ellipsoids, **values):
    """A PLY of ellipsoids whose first splat has other values in some columns."""
    splats.write_splat_ply(path, ellipsoids)
    header, end, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[2].decode() for line in header.splitlines() if b"property" in line]
    rows = np.frombuffer(body, np.float32).reshape(len(ellipsoids), len(names)).copy()
    for name, value in values.items():
        rows[0, names.index(name)] = value
    path.write_bytes(header + end + rows.tobytes())
    return path


@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_5", "opacity", "scale_2", "rot_0"])
def test_splats_that_are_not_numbers_are_left_out(tmp_path, ellipsoids, caplog, name):
    path = changed(tmp_path / "map.ply", ellipsoids, **{name: np.nan})
    assert len(read_cloud(path)) == len(ellipsoids) - 1
    assert "1 of 50 splats are not finite and left out" in caplog.text


def test_discs_and_giants_are_rendered(tmp_path, ellipsoids):
    """A scale of e^40 covers everything or nothing; no image is made of NaN."""
    camera = Camera(40.0, 40.0, 15.5, 15.5, 32, 32)
    T_camera_map = se3.exp(np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))
    for value in (40.0, -np.inf, -40.0):
        path = changed(tmp_path / "map.ply", ellipsoids, scale_0=value, opacity=np.inf)
        images = render(read_cloud(path), camera, T_camera_map).images
        assert bool(torch.isfinite(images).all())


def test_opacities_of_0_and_1_are_written(tmp_path, cloud):
    """As those of files of bytes; a writer that skips infinite values shifts all that follow."""
    logits = cloud.opacity_logits.clone()
    logits[0], logits[1] = np.inf, -np.inf
    splats.write_splat_ply(tmp_path / "map.ply", replace(cloud, opacity_logits=logits))
    read = read_cloud(tmp_path / "map.ply")
    torch.testing.assert_close(read.opacities, logits.sigmoid())
    torch.testing.assert_close(read.means, cloud.means)


def test_a_file_without_any_number_is_refused(tmp_path, ellipsoids):
    one = ellipsoids.select(torch.tensor([0]))
    with pytest.raises(FormatError, match="no splat with finite values"):
        read_cloud(changed(tmp_path / "map.ply", one, x=np.nan))


def test_a_file_that_announces_more_than_it_has_is_truncated(tmp_path, ellipsoids):
    splats.write_splat_ply(tmp_path / "map.ply", ellipsoids)
    content = (tmp_path / "map.ply").read_bytes()
    (tmp_path / "map.ply").write_bytes(content.replace(b"vertex 50", b"vertex 1000000000"))
    with pytest.raises(FormatError, match="is truncated"):
        read_cloud(tmp_path / "map.ply")
