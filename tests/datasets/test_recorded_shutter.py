"""The rolling shutter of a recording on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from moving_room import CAMERA, MovingRoom

from toolkit.datasets.checks import check_recording
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images

READOUT_S = 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A room with a rolling shutter in the layout `folder`, one frame of it delivered twice."""
    folder = tmp_path_factory.mktemp("room") / "mine"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    taken_s = np.arange(54) / 30
    taken_s[53] = taken_s[52]
    room = MovingRoom(np.arange(54) / 30, READOUT_S, taken_s=taken_s)
    for index in range(54):
        frame = room[index]
        images.write_rgb(folder / f"rgb/{index}.png", frame.rgb)
        images.write_depth_png(folder / f"depth/{index}.png", frame.depth_m, 5000)
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    lines = [f"{key}: {getattr(CAMERA, key)}" for key in keys]
    (folder / "intrinsics.yaml").write_text("\n".join([*lines, "depth_scale: 5000"]))
    return folder


def test_the_readout_is_estimated_by_default(folder):
    assert open_dataset("folder", folder)[0].readout_s == pytest.approx(READOUT_S, abs=1.5e-3)
    # Half of the rows remain.
    width, height = CAMERA.size
    cropped = open_dataset("folder", folder, image_size=(2 * width, height), max_frames=53)
    assert cropped[0].readout_s == pytest.approx(READOUT_S / 2, abs=1e-3)


def test_a_stated_readout_is_used(folder):
    for readout_ms in (0, 12):
        options = DatasetOptions(readout_ms=readout_ms)
        stated = open_dataset("folder", folder, options=options)[0]
        assert stated.readout_s == pytest.approx(1e-3 * readout_ms)
    assert open_dataset("folder", folder, needs_depth=False)[0].readout_s == 0.0


def test_few_frames_do_not_determine_it(folder):
    assert open_dataset("folder", folder, max_frames=30)[0].readout_s == 0.0


def test_the_check_reports_it_and_images_that_are_copies(folder):
    report = check_recording(describe("folder", folder))
    assert report.good, report.faults
    (line,) = [line for line in report.summary if line.startswith("rolling shutter")]
    readout_ms = float(line.split("readout ")[1].split()[0])
    assert readout_ms == pytest.approx(1e3 * READOUT_S, abs=1.5)
    assert "standard deviation" in line
    (note,) = [note for note in report.notes if "frame before" in note]
    assert note.startswith("1 colour and 1 depth image(s)") and "53" in note
