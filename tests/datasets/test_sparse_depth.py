"""Depth in single pixels and lines is interpolated on surfaces, neither beyond nor across them."""

import json

import cv2
import numpy as np
import pytest
import yaml

from toolkit.base.options import validated
from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe, open_dataset
from toolkit.datasets.sparse_depth import filled, sparsity
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io import images
from toolkit.io.trajectories import write_tum
from toolkit.runs.execution import run
from toolkit.runs.settings import RunSettings

HEIGHT, WIDTH = 90, 120


def slanted_and_near() -> np.ndarray:
    """Depth of a slanted wall and a box in front of it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth_m = 1.0 / (0.3 + 0.001 * u + 0.0005 * v)
    depth_m[30:60, 40:80] = 1.2
    return depth_m.astype(np.float32)


def samples_of(kind: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    if kind == "rows":
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[2::6] = True
        return mask
    return rng.random((HEIGHT, WIDTH)) < float(kind)


@pytest.mark.parametrize("kind", ["0.9", "0.5", "0.2", "0.05", "rows"])
def test_gaps_are_filled_on_surfaces(kind):
    truth, mask = slanted_and_near(), samples_of(kind)
    sparse = np.where(mask, truth, np.float32(0))
    found = sparsity([sparse])
    assert found.is_sparse
    dense = filled(sparse, found.window_px)
    np.testing.assert_array_equal(dense[mask], truth[mask])
    added = (dense > 0) & ~mask
    assert (dense > 0).mean() > 0.75
    errors = np.abs(dense / truth - 1.0)[added]
    assert np.percentile(errors, 90) < 0.005
    # Nothing lies between the surfaces, where neither has been measured.
    assert (np.abs(dense / 1.2 - 1.0)[added] < 0.05).sum() < 1.3 * 30 * 40
    assert np.percentile(errors, 97) < 0.06


def test_what_was_not_measured_stays_missing():
    truth, mask = slanted_and_near(), samples_of("0.2")
    mask[:, 90:] = False
    dense = filled(np.where(mask, truth, np.float32(0)), 2.0)
    assert not dense[:, 96:].any()


@pytest.mark.parametrize("holes", [0, 6])
def test_connected_depth_is_not_sparse(holes):
    depth_m = slanted_and_near()
    for k in range(holes):
        depth_m[10 * k : 10 * k + 8, 15 * k : 15 * k + 12] = 0
    assert not sparsity([depth_m]).is_sparse
    assert not sparsity([np.zeros_like(depth_m)]).is_sparse


@pytest.fixture(params=["0.5", "0.05", "rows"])
def sparse_recording(request, tmp_path):
    """A room whose depth is sparse."""
    folder = tmp_path / "sparse"
    frames, truth = tiny_room(6, WIDTH, HEIGHT)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    mask = samples_of(request.param)
    for frame in frames:
        depth_m = np.where(np.roll(mask, frame.index, axis=0), frame.depth_m, np.float32(0))
        images.write_rgb(folder / f"rgb/{frame.index}.png", frame.rgb)
        images.write_depth_png(folder / f"depth/{frame.index}.png", depth_m, 5000.0)
    camera = frames[0].camera
    values = {n: getattr(camera, n) for n in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "intrinsics.yaml").write_text(
        yaml.safe_dump(values | {"depth_scale": 5000.0, "fps": 30.0})
    )
    write_tum(folder / "trajectory.txt", truth)
    return folder


def test_a_recording_of_sparse_depth_is_tracked(sparse_recording, tmp_path):
    notes = check_recording(describe("folder", sparse_recording)).notes
    assert any("it is interpolated between samples" in note for note in notes)
    raw = cv2.imread(str(sparse_recording / "depth/3.png"), cv2.IMREAD_UNCHANGED)
    frame = open_dataset("folder", sparse_recording)[3]
    assert (frame.depth_m > 0).mean() > max(0.7, (raw > 0).mean())
    place = {"kind": "folder", "path": str(sparse_recording)}
    run(validated(RunSettings, {"dataset": place}), tmp_path / "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["frames"]["lost"] == metrics["frames"]["doubtful"] == 0
    assert metrics["trajectory"]["ate_rmse_cm"] < 0.5
