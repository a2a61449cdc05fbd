"""`semsplat train-head` on a tiny labelled recording and a tiny random encoder."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence
from toolkit.semantics.factory import build_segmenter
from toolkit.semantics.options import ModelOptions, SegmenterOptions
from toolkit.semantics.segmenters.linear_head import LinearHead
from toolkit.tools.cli.main import main

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory) -> Path:
    """Five frames: a red wall above a green floor, their border at another height each."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    frames = []
    for index in range(5):
        floor = np.zeros((48, 64), bool)
        floor[8 + 8 * index :] = True
        rgb = np.where(floor[..., None], [0.1, 0.8, 0.1], [0.8, 0.1, 0.1]).astype(np.float32)
        labels = np.where(floor, CLASS_IDS["floor"], CLASS_IDS["wall"]).astype(np.int32)
        depth_m = np.ones((48, 64), np.float32)
        frames.append(Frame(index, index / 30.0, rgb, depth_m, CAMERA, labels))
    prepare_folder(folder)
    write_sequence(folder, frames, CAMERA, np.tile(np.eye(4), (5, 1, 1)))
    return folder


def words(labelled: Path, tiny_dinov2: Path, out: Path, *more: str) -> list[str]:
    data = ["--dataset.kind", "replica", "--dataset.path", str(labelled)]
    return ["train-head", *data, "--model", str(tiny_dinov2), "--out", str(out), *more]


def test_a_head_is_trained_measured_on_held_out_frames_and_written(
    labelled, tiny_dinov2, tmp_path, capsys
):
    out = tmp_path / "head.safetensors"
    assert main(words(labelled, tiny_dinov2, out, "--hold-out", "3", "--longest-side", "64")) == 0
    printed = capsys.readouterr().out
    assert "training frames         4\nheld-out frames         1\n" in printed
    accuracy = re.search(r"held-out accuracy +([\d.]+)", printed)
    assert float(accuracy.group(1)) > 0.9
    assert LinearHead.load(out).class_names == ("floor", "wall")


def test_without_a_model_the_indoor_network_is_the_encoder(labelled, tmp_path, capsys, monkeypatch):
    # Neither for training nor for use.
    monkeypatch.setitem(sys.modules, "transformers", None)
    out = tmp_path / "head.safetensors"
    data = ["--dataset.kind", "replica", "--dataset.path", str(labelled), "--hold-out", "3"]
    assert main(["train-head", *data, "--out", str(out)]) == 0
    accuracy = re.search(r"held-out accuracy +([\d.]+)", capsys.readouterr().out)
    assert float(accuracy.group(1)) > 0.9
    options = SegmenterOptions("model", model=ModelOptions(head=out))
    segmenter = build_segmenter(options, None)
    assert tuple(segmenter.class_names.values()) == ("floor", "wall")
    frame = open_dataset("replica", labelled)[4]
    found = segmenter.segment(frame)
    assert set(np.unique(found)) == {0, 1, 2} or set(np.unique(found)) == {1, 2}
    assert (found[frame.labels == CLASS_IDS["floor"]] != 2).all()


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["--hold-out", "1"], "--hold-out: input should be greater than or equal to 2, got 1"),
        (["--hold-out", "9"], "no frame is left for evaluation"),
        (["--out", "head.bin"], "--out must end in .safetensors"),
        (["--model", "nowhere"], "nowhere has no config.json"),
    ],
)
def test_wrong_options_are_one_line(labelled, tiny_dinov2, tmp_path, capsys, more, named):
    assert main(words(labelled, tiny_dinov2, tmp_path / "head.safetensors", *more)) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("semsplat: error: ")
    assert named in line
    assert not (tmp_path / "head.safetensors").exists()


def test_a_data_set_without_labels_is_named(labelled, tiny_dinov2, tmp_path, capsys):
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("results", "traj.txt", "cam_params.json"):
        (bare / name).symlink_to(labelled / name)
    assert main(words(bare, tiny_dinov2, tmp_path / "head.safetensors")) == 2
    assert "has no labels for training" in capsys.readouterr().err


def test_a_missing_library_is_one_line(labelled, tiny_dinov2, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert main(words(labelled, tiny_dinov2, tmp_path / "head.safetensors")) == 2
    assert "fix it with: pip install 'semsplat[semantics]'" in capsys.readouterr().err
