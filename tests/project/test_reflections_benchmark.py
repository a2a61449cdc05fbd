"""How `benchmarks.reflections` groups the pixels of a view, and what it compares."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks import reflections
from benchmarks.recordings import ROOMS
from toolkit.datasets.synthetic_rooms.finishes import Finish


def test_every_pixel_belongs_to_one_group(tmp_path):
    finish = np.array([[f] * 4 for f in Finish][:4], np.uint8)
    (tmp_path / "surface").mkdir()
    cv2.imwrite(str(tmp_path / "surface" / "finish000002.png"), finish)
    masks = dict(reflections.groups(tmp_path, 2))
    assert tuple(masks) == reflections.GROUPS
    assert (sum(mask.astype(int) for mask in masks.values()) == 1).all()
    np.testing.assert_array_equal(masks["mirror"], finish == Finish.MIRROR)
    np.testing.assert_array_equal(masks["floor"], finish == Finish.LACQUER)


def test_a_missing_view_is_reported(tmp_path):
    with pytest.raises(SystemExit, match="is missing"):
        list(reflections.groups(tmp_path, 0))


def test_the_rooms_differ_in_gloss_only():
    matt, glossy, polished = (ROOMS[name] for name in reflections.ROOMS.values())
    assert glossy == (*matt, "--glossy")
    assert polished[:-1] == (*glossy, "--polish")


def test_targets_compare_with_the_matt_room():
    rows = {
        name: [{reflections.ATE: ate, "psnr elsewhere db": psnr, "frames.lost": 0}]
        for name, ate, psnr in (("matt", 0.2, 33.0), ("glossy", 0.5, 32.0))
    }
    values = {target.label: (target.value, target.met) for target in reflections.targets(rows)}
    assert values["ATE, as a multiple of that of the matt room"] == (2.5, False)
    assert values["PSNR elsewhere, dB less"] == (1.0, False)
    assert values["lost frames"] == (0.0, True)
    assert values["doubtful frames"] == (None, None)
