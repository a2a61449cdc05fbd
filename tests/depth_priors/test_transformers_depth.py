"""Depth models of transformers with random weights: meaning, sizes, errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_depth_models import ARCHITECTURES, save

from toolkit.base.errors import FormatError, SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.factory import build_provider
from toolkit.depth.depth_priors.options import DepthPriorOptions, PriorModelOptions
from toolkit.depth.depth_priors.provider import DepthKind, DepthPrior

CAMERA = Camera(70.0, 70.0, 39.5, 29.5, 80, 60)
SHAPE = (60, 80)

pytest.importorskip("transformers")


def frame(camera: Camera = CAMERA) -> Frame:
    rng = np.random.default_rng(0)
    rgb = rng.random((*SHAPE, 3), np.float32)
    return Frame(3, 0.0, rgb, np.zeros(SHAPE, np.float32), camera)


def provider(folder: Path, **options):
    model = PriorModelOptions(path=folder, **options)
    return build_provider(DepthPriorOptions(kind="transformers", model=model), [], CAMERA)


def prior(folder: Path, **options) -> DepthPrior:
    predicted = provider(folder, **options).predict([frame()])
    assert predicted.indices == (3,)
    return predicted.priors[0]


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("models")
    return {name: save(root / name, name) for name in ARCHITECTURES}


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_every_pixel_of_the_frame_gets_a_value(folders, name):
    found = prior(folders[name])
    expected = {"zoedepth", "glpn", "depth_pro"}
    assert found.kind == (DepthKind.METRIC if name in expected else DepthKind.AFFINE_INVERSE)
    image = found.in_frame(CAMERA.size)
    # A random network may return depths of 0, which are unknown; the frame's border is covered.
    columns, rows = found.pixels.pixels(CAMERA.size)
    height, width = found.values.shape
    assert columns.min() > -0.5
    assert rows.min() > -0.5
    assert columns.max() < width - 0.5
    assert rows.max() < height - 0.5
    if found.kind is DepthKind.AFFINE_INVERSE:
        assert image.known.all()
    assert len(found.model.sha256) == 64


@pytest.mark.parametrize("name", ["depth_anything", "prompt_depth_anything"])
def test_depth_anything_states_what_it_predicts(tmp_path, name):
    metric = save(tmp_path / "m", name, depth_estimation_type="metric", max_depth=20)
    found = prior(metric)
    assert found.kind is DepthKind.METRIC
    assert found.values.max() <= 20.0


def test_the_meaning_can_be_set(folders):
    assert prior(folders["dpt"], values="metric").kind is DepthKind.METRIC


def test_the_padding_of_zoedepth_is_removed_as_by_its_processor(folders):
    """Its processor resizes to the padded size and cuts the padding off; that needs torchvision."""
    import torch

    found = prior(folders["zoedepth"])
    rows, columns = (int(np.sqrt(size / 2) * 3) for size in SHAPE)
    raw = torch.from_numpy(found.values)[None, None]
    padded = (SHAPE[0] + 2 * rows, SHAPE[1] + 2 * columns)
    theirs = torch.nn.functional.interpolate(raw, padded, mode="bilinear")[0, 0].numpy()
    theirs = theirs[rows:-rows, columns:-columns]
    ours = found.in_frame(CAMERA.size).values
    assert np.median(np.abs(ours - theirs) / np.abs(theirs)) < 0.01
    # At half a padding's shift the values differ more.
    moved = np.roll(ours, columns // 2, axis=1)
    assert np.abs(moved - theirs).mean() > 2.0 * np.abs(ours - theirs).mean()


def test_the_depth_of_depth_pro_scales_with_the_focal_length(folders):
    from dataclasses import replace

    longer = replace(CAMERA, fx=140.0, fy=140.0)
    model = provider(folders["depth_pro"])
    usual, twice = (model.predict([frame(c)]).priors[0].values for c in (CAMERA, longer))
    assert np.allclose(twice, 2.0 * usual)


def test_the_licence_is_that_of_the_model_card(tmp_path):
    folder = save(tmp_path / "m", "glpn")
    assert provider(folder).model.licence == "unknown"
    (folder / "README.md").write_text("---\nlicense: apache-2.0\ntags: []\n---\n# Model\n")
    assert provider(folder).model.licence == "apache-2.0"


def test_weights_have_an_identity(tmp_path):
    folder = save(tmp_path / "m", "glpn")
    before = provider(folder).model.sha256
    assert provider(folder).model.sha256 == before
    with (folder / "other.bin").open("wb") as file:
        file.write(b"more")
    assert provider(folder).model.sha256 != before


def test_other_folders_are_refused(tmp_path, folders):
    with pytest.raises(FormatError, match=r"no config\.json"):
        provider(tmp_path)
    config = json.loads((folders["glpn"] / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(FormatError, match="download it again"):
        provider(tmp_path)
    with pytest.raises(SettingsError, match=r"--depth-prior\.model\.path"):
        build_provider(DepthPriorOptions(kind="transformers"), [], CAMERA)


def test_depth_pro_needs_its_processor(tmp_path):
    folder = save(tmp_path / "m", "depth_pro")
    (folder / "preprocessor_config.json").unlink()
    with pytest.raises(FormatError, match="preprocessor_config"):
        provider(folder)
