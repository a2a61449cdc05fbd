"""Rooms with the imperfections of real recordings: white balance, edges, reflections, a walker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.datasets.synthetic_rooms import RoomSettings, SensorModel, make_room
from toolkit.datasets.synthetic_rooms.imperfections import (
    white_balance_gains,
    with_flying_pixels,
    without_reflections,
)
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

FRAMES = 10
CLEAN = RoomSettings(frames=FRAMES, share=0.1, width=64, height=48, unseen=1)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("rooms")
    settings = {
        "clean": CLEAN,
        "walker": replace(CLEAN, walker=True),
        "real": replace(CLEAN, walker=True, sensor=SensorModel.of(noise=False, real=True)),
        "again": replace(CLEAN, walker=True, sensor=SensorModel.of(noise=False, real=True)),
    }
    for name, values in settings.items():
        make_room(base / name, values)
    return {name: base / name for name in settings}


def images(folder: Path, pattern: str) -> np.ndarray:
    return np.stack([cv2.imread(str(p), -1) for p in sorted(folder.glob(pattern))])


def test_a_room_with_a_walker_differs_from_the_same_room_within_the_masks_only(folders):
    masks = images(folders["walker"], "walker/*.png") > 0
    assert len(masks) == FRAMES
    for pattern in ("results/frame*", "results/depth*", "labels/label*"):
        clean, walked = (images(folders[name], pattern) for name in ("clean", "walker"))
        changed = (clean != walked).reshape(*masks.shape, -1).any(axis=-1)
        # Lens blur of a single level reaches a pixel farther than the mask.
        wide = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((5, 5))) > 0 for m in masks])
        assert changed.any() and not (changed & ~wide).any()
    shares = masks.mean(axis=(1, 2))
    assert (shares == 0).any() and 0.02 < shares.max() < 0.5
    assert not (folders["clean"] / "walker").exists()


def test_the_walker_is_in_front_and_has_no_label(folders):
    clean, walked = (images(folders[n], "results/depth*") for n in ("clean", "walker"))
    assert (walked <= clean).all()
    labels = images(folders["walker"], "labels/*.png")
    assert (labels[walked < clean] == 0).all()


def test_real_rooms_have_the_path_and_unseen_views_of_the_clean_room(folders):
    clean, real = folders["clean"], folders["real"]
    for name in ("traj.txt", "unseen/results/frame000000.png", "mesh.ply"):
        assert (clean / name).read_bytes() == (real / name).read_bytes()
    depth, true = (images(folders[n], "results/depth*") for n in ("real", "walker"))
    assert 0.01 < (depth == 0).mean() < 0.6
    assert 0.002 < ((depth > 0) & (depth != true)).mean() < 0.2


def test_real_rooms_are_reproducible(folders):
    first, second = folders["real"], folders["again"]
    files = [p.relative_to(first) for p in first.rglob("*.png")]
    assert files and all((first / f).read_bytes() == (second / f).read_bytes() for f in files)


def test_remaking_a_room_without_a_walker_removes_its_masks(tmp_path):
    make_room(tmp_path, replace(CLEAN, frames=2, unseen=0, walker=True))
    make_room(tmp_path, replace(CLEAN, frames=2, unseen=0))
    assert not list(tmp_path.glob("walker/*.png"))


def test_white_balance_starts_neutral_and_changes_the_channels_differently_and_smoothly():
    gains = white_balance_gains(300, np.random.default_rng(0))
    np.testing.assert_allclose(gains[0], 1.0)
    assert np.ptp(gains[:, 0] / gains[:, 2]) > 0.1
    assert np.abs(np.diff(gains, axis=0)).max() < 0.03
    assert gains.min() > 0.7 and gains.max() < 1.4


def test_flying_pixels_lie_between_both_surfaces_beside_an_edge():
    true = np.full((40, 40), 1.0, np.float32)
    true[:, 20:] = 3.0
    depth = with_flying_pixels(true, true, np.random.default_rng(0))
    wrong = depth != true
    assert wrong[:, 18:22].mean() > 0.2 and not wrong[:, :18].any() and not wrong[:, 22:].any()
    assert ((depth[wrong] > 1.0) & (depth[wrong] < 3.0)).all()


@pytest.mark.parametrize(("cosine", "lost"), [(0.98, True), (0.6, False), (0.2, True)])
def test_shiny_objects_return_depth_at_a_middle_angle_only(cosine: float, lost: bool):
    labels = np.full((20, 20), CLASS_IDS["wall"], np.int32)
    labels[:, 10:] = CLASS_IDS["tv-screen"]
    cosines = np.full(labels.shape, cosine, np.float32)
    depth = np.full(labels.shape, 2.0, np.float32)
    found = without_reflections(depth, labels, cosines, np.random.default_rng(0))
    assert (found[:, :10] == 2.0).all()
    assert (found[:, 10:] == 0).mean() == pytest.approx(float(lost), abs=0.1)
