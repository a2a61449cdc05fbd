"""What a run has estimated of its recording is stored with it, and not estimated again."""

import json
from dataclasses import replace

import numpy as np
import pytest
from moving_room import CAMERA, write_recording

from toolkit.base.errors import RunFolderError
from toolkit.datasets import preparation
from toolkit.datasets.agreement.refine import with_intrinsics
from toolkit.datasets.depth_offset import DepthOffset
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import open_place
from toolkit.datasets.shutter.estimate import ShutterEstimate
from toolkit.runs.maps.finished import load_run
from toolkit.tools.cli.main import main

# Values with many digits.
REFINED = replace(CAMERA, fx=CAMERA.fx / 1.1, cx=CAMERA.cx + 1 / 3)
DISTORTION = (-0.2 / 3, 0.0, 0.0, 0.0, 0.0)
READOUT = ShutterEstimate(readout_s=0.1 / 7, readout_sigma_s=1e-4 / 3, period_s=0.05)
OFFSET = DepthOffset(2 / 3, 0.0, 0.01, (0.0, 0.0), 1000)
ESTIMATORS = {
    "with_refined_intrinsics": lambda stated, _: with_intrinsics(stated, REFINED, DISTORTION),
    "estimate_readout": lambda *_: READOUT,
    "estimate_depth_offset": lambda _: OFFSET,
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    path = write_recording(tmp_path_factory.mktemp("estimates") / "room", np.arange(6) / 20.0)
    return DatasetOptions("folder", path, intrinsics="refine", depth_offset="auto")


@pytest.fixture
def first(place, monkeypatch):
    """The recording, whose intrinsics, readout and offset can be estimated only once."""
    for name, estimate in ESTIMATORS.items():
        monkeypatch.setattr(preparation, name, estimate)
    dataset = open_place(place)
    for name in ESTIMATORS:
        monkeypatch.delattr(preparation, name)
    return dataset


def stored(dataset):
    estimates = RecordingEstimates.of(dataset.recording).to_json()
    return RecordingEstimates.from_json(json.loads(json.dumps(estimates)))


def test_a_recording_is_opened_again_without_estimation(place, first):
    assert first.camera == REFINED
    assert first.recording.readout_s == READOUT.readout_s
    again = open_place(place, known=stored(first))
    for name in ("camera", "distortion", "depth_offset_px", "readout_s", "readout_sigma_s"):
        assert getattr(again.recording, name) == getattr(first.recording, name)
    assert again.recording.notes == first.recording.notes
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth_m, b.depth_m)
        assert (a.camera, a.readout_s) == (b.camera, b.readout_s)


def test_stated_values_are_not_replaced(place, first):
    options = replace(place, intrinsics="stated", depth_offset=(2.0, 0.0), readout_ms=12.0)
    recording = open_place(options, known=stored(first)).recording
    assert (recording.camera, recording.distortion) == (CAMERA, None)
    assert (recording.depth_offset_px, recording.readout_s) == ((2.0, 0.0), 0.012)


def test_estimates_of_images_of_another_size_are_not_used(place, first, monkeypatch):
    small = replace(stored(first), camera=replace(REFINED, width=48, height=36))
    for name, estimate in ESTIMATORS.items():
        monkeypatch.setattr(preparation, name, estimate, raising=False)
    assert open_place(place, known=small).camera == REFINED


def test_a_run_stores_its_estimates(place, tmp_path, monkeypatch):
    run = tmp_path / "run"
    words = ["--dataset.kind", "folder", "--dataset.path", str(place.path)]
    with monkeypatch.context() as patched:
        for name, estimate in ESTIMATORS.items():
            patched.setattr(preparation, name, estimate)
        refine = ["--dataset.intrinsics", "refine", "--dataset.depth-offset", "auto"]
        assert main(["run", "--out", str(run), *words, *refine, "--max-frames", "3"]) == 0
    for name in ESTIMATORS:
        monkeypatch.delattr(preparation, name)
    finished = load_run(run)
    assert finished.open_dataset().camera == finished.camera == REFINED
    assert main(["evaluate", str(run)]) == 0
    content = json.loads((run / "frames.json").read_text())
    content["recording"].pop("camera")
    (run / "frames.json").write_text(json.dumps(content))
    with pytest.raises(RunFolderError, match=r"frames\.json is damaged"):
        load_run(run)
