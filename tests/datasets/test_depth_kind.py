"""Depth images that hold distances along the rays, or inverse depth, are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.datasets.depth_kind import depth_kind_fault
from toolkit.datasets.synthetic_rooms import tiny_room


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return tiny_room(4, 96, 72)[0]


def distances(frame: Frame) -> Frame:
    rays = np.linalg.norm(frame.camera.rays(), axis=2)
    return replace(frame, depth_m=(frame.depth_m * rays).astype(np.float32))


def inverse(frame: Frame) -> Frame:
    return replace(frame, depth_m=(3.0 / frame.depth_m).astype(np.float32))


def noisy(frame: Frame) -> Frame:
    noise = np.random.default_rng(0).normal(1.0, 0.01, frame.depth_m.shape)
    return replace(frame, depth_m=(frame.depth_m * noise).astype(np.float32))


def test_z_depth_is_accepted(frames):
    assert depth_kind_fault(frames) is None
    assert depth_kind_fault([]) is None


@pytest.mark.parametrize(
    ("change", "words"), [(distances, "distances along the rays"), (inverse, "inverse depth")]
)
def test_other_kinds_of_depth_are_named(frames, change, words):
    assert words in (depth_kind_fault([change(frame) for frame in frames]) or "")


@pytest.mark.parametrize("change", [distances, inverse])
def test_noise_decides_nothing(frames, change):
    assert depth_kind_fault([noisy(change(frame)) for frame in frames]) is None


def test_a_wall_at_one_depth_decides_nothing(frames):
    wall = [replace(frame, depth_m=np.full_like(frame.depth_m, 2.5)) for frame in frames]
    assert depth_kind_fault(wall) is None


def test_missing_depth_is_left_out(frames):
    holes = [distances(frame) for frame in frames]
    for frame in holes:
        frame.depth_m[:, ::16] = 0.0
    assert depth_kind_fault(holes) is not None
    assert depth_kind_fault([replace(f, depth_m=np.zeros_like(f.depth_m)) for f in frames]) is None
