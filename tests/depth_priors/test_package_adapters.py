"""Adapters of model packages against their published signatures; the packages are stand-ins."""

from __future__ import annotations

import sys
from pathlib import Path

import fake_packages
import numpy as np
import pytest
from fake_packages import DEPTH_SCALE, POSES, plane

from toolkit.base.errors import DependencyError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.factory import build_provider
from toolkit.depth.depth_priors.options import DepthPriorOptions, PriorModelOptions
from toolkit.depth.depth_priors.provider import DepthKind, ScaleScope

CAMERA = Camera(90.0, 90.0, 51.5, 39.5, 104, 80)
PORTRAIT = Camera(90.0, 90.0, 29.5, 59.5, 60, 120)
KINDS = ("dust3r", "mast3r", "depth-anything-3", "moge", "vggt")


def position(camera: Camera) -> list[np.ndarray]:
    return np.meshgrid(*((np.arange(n) + 0.5) / n for n in camera.size))


def frame(index: int, camera: Camera = CAMERA) -> Frame:
    """A frame whose red and green are the column and the row."""
    columns, rows = position(camera)
    rgb = np.stack([columns, rows, np.zeros_like(rows)], -1).astype(np.float32)
    return Frame(index, float(index), rgb, np.zeros(rows.shape, np.float32), camera)


@pytest.fixture
def packages(monkeypatch) -> None:
    fake_packages.install_dust3r(monkeypatch)
    fake_packages.install_depth_anything_3(monkeypatch)
    fake_packages.install_moge(monkeypatch)
    fake_packages.install_vggt(monkeypatch)


def provider(kind: str, folder: Path, **options):
    (folder / "model.pt").write_bytes(b"weights")
    model = PriorModelOptions(path=folder, **options)
    return build_provider(DepthPriorOptions(kind=kind, model=model), [], CAMERA)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("camera", [CAMERA, PORTRAIT], ids=["landscape", "portrait"])
@pytest.mark.usefixtures("packages")
def test_depth_returns_to_the_pixels_of_the_frames(kind, camera, tmp_path):
    model = provider(kind, tmp_path)
    found = model.predict([frame(n, camera) for n in (3, 7, 11)])
    assert found.indices == (3, 7, 11)
    expected = DEPTH_SCALE * plane(*position(camera))
    for prior in found.priors:
        image = prior.in_frame(camera.size)
        assert image.known.mean() > (0.8 if camera is CAMERA else 0.45)
        error = np.abs(image.values / expected - 1.0)[image.known]
        assert np.percentile(error, 99) < 0.01
    assert model.joint == (kind != "moge")


@pytest.mark.parametrize("kind", ["dust3r", "mast3r", "depth-anything-3", "vggt"])
@pytest.mark.usefixtures("packages")
def test_sets_have_relative_poses_and_one_scale(kind, tmp_path):
    found = provider(kind, tmp_path).predict([frame(n) for n in range(4)])
    assert np.allclose(found.T_first_camera, np.linalg.inv(POSES[0]) @ POSES[:4])
    for prior in found.priors:
        assert (prior.kind, prior.scope) == (DepthKind.SCALED, ScaleScope.SET)
        assert (prior.confidence.values >= 1.0).all()


@pytest.mark.parametrize("kind", ["dust3r", "mast3r"])
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.usefixtures("packages")
def test_small_sets_are_pairs(kind, count, tmp_path):
    found = provider(kind, tmp_path).predict([frame(n) for n in range(5, 5 + count)])
    assert found.indices == tuple(range(5, 5 + count))
    assert np.allclose(found.T_first_camera, np.linalg.inv(POSES[0]) @ POSES[:count])
    expected = DEPTH_SCALE * plane(*position(CAMERA))
    for number, prior in enumerate(found.priors):
        image = prior.in_frame(CAMERA.size)
        assert image.known.mean() > 0.8
        assert np.percentile(np.abs(image.values / expected - 1.0)[image.known], 99) < 0.01
        # The stand-in's confidence is 3 for the first image of the pair, 4 for the second.
        assert (prior.confidence.values == 3.0 + number).all()
    assert len(found.priors) == count


@pytest.mark.parametrize("kind", ["depth-anything-3", "vggt"])
@pytest.mark.usefixtures("packages")
def test_estimated_intrinsics_refer_to_the_depth_map(kind, tmp_path):
    prior = provider(kind, tmp_path).predict([frame(0)]).priors[0]
    assert prior.camera.size == prior.values.shape[::-1]
    assert prior.camera.cx == pytest.approx((prior.camera.width - 1) / 2)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("packages")
def test_the_model_is_named_with_its_licence(kind, tmp_path):
    model = provider(kind, tmp_path).model
    assert kind in model.name
    assert len(model.sha256) == 64
    assert model.licence != "unknown"


@pytest.mark.usefixtures("packages")
def test_pixels_below_the_minimum_confidence_are_unknown(tmp_path):
    prior = provider("vggt", tmp_path, min_confidence=2.5).predict([frame(0)]).priors[0]
    assert not prior.in_frame(CAMERA.size).known.any()


@pytest.mark.usefixtures("packages")
def test_sky_has_no_depth(tmp_path):
    prior = provider("depth-anything-3", tmp_path).predict([frame(0)]).priors[0]
    assert not prior.valid[0].any()
    assert prior.valid[1:].all()


@pytest.mark.parametrize(
    ("metric", "expected"),
    [
        (True, (DepthKind.METRIC, ScaleScope.SEQUENCE)),
        (False, (DepthKind.SCALED, ScaleScope.FRAME)),
    ],
)
def test_moge_gets_the_field_of_view(tmp_path, monkeypatch, metric, expected):
    fake_packages.install_moge(monkeypatch, metric)
    model = provider("moge", tmp_path)
    prior = model.predict([frame(0)]).priors[0]
    assert (prior.kind, prior.scope) == expected
    assert model._network.fov_x == pytest.approx(2 * np.degrees(np.arctan(52.0 / 90.0)))
    assert not prior.valid[0].any()


def test_depth_anything_3_may_be_metric(tmp_path, monkeypatch):
    fake_packages.install_depth_anything_3(monkeypatch, metric=1)
    prior = provider("depth-anything-3", tmp_path).predict([frame(0)]).priors[0]
    assert (prior.kind, prior.scope) == (DepthKind.METRIC, ScaleScope.SEQUENCE)


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_package_has_a_remedy(kind, tmp_path):
    with pytest.raises(DependencyError, match=r"github\.com.*--depth-prior\.model\.code") as error:
        provider(kind, tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("packages")
def test_missing_weights_are_not_downloaded(kind, tmp_path):
    options = PriorModelOptions(path=tmp_path / "none")
    with pytest.raises(FormatError, match=r"--depth-prior\.model\.path"):
        build_provider(DepthPriorOptions(kind=kind, model=options), [], CAMERA)


def test_a_repository_can_be_used_without_installation(tmp_path, monkeypatch):
    code = tmp_path / "repository"
    (code / "moge" / "model").mkdir(parents=True)
    (code / "moge" / "model" / "v2.py").write_text("raise OSError('no CUDA')")
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(DependencyError, match="no CUDA"):
        provider("moge", tmp_path, code=code)
