"""Offsets between the observed images of two keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from registered_room import Scene, error, motion, seen_by

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.semantics.features.keypoints import Keypoints
from toolkit.splatting.alignment import matching
from toolkit.splatting.alignment.matching import (
    Matched,
    match_features,
    measure_offset,
    rigid_fits,
    similarity_fits,
)

seeds = st.integers(0, 10_000)
few = settings(max_examples=15)


def true_offset(submaps: Scene, i: int, j: int) -> np.ndarray:
    T_camera_target = se3.inverse(submaps.target.keyframes[i].T_map_camera)
    return T_camera_target @ submaps.T_target_source @ submaps.source.keyframes[j].T_map_camera


@pytest.mark.parametrize(("i", "j"), [(0, 0), (1, 1), (3, 2)])
def test_an_offset_is_measured_to_a_fraction_of_a_millimetre(submaps: Scene, i, j):
    offset = measure_offset(submaps.target.keyframes[i], submaps.source.keyframes[j])
    assert offset is not None
    mm, deg = error(offset.T_first_second, true_offset(submaps, i, j))
    assert mm < 1.0
    assert deg < 0.03
    assert offset.matches >= 12
    x = se3.log(se3.inverse(offset.T_first_second) @ true_offset(submaps, i, j))
    assert 0.01 < x @ offset.information @ x < 12.6  # chi-square of six: 95 % lie below
    assert np.linalg.eigvalsh(offset.information)[0] > 0


@pytest.mark.parametrize("order", ["larger first", "larger second"])
def test_offsets_between_two_cameras_are_unbiased(submaps: Scene, order):
    """Half as large again, another focal length, another principal point."""
    other = Camera(250.0, 262.0, 110.0, 98.0, 240, 180)
    first, second = submaps.target.keyframes[1], submaps.source.keyframes[1]
    if order == "larger first":
        first = seen_by(first, other)
    else:
        second = seen_by(second, other)
    offset = measure_offset(first, second)
    assert offset is not None
    mm, deg = error(offset.T_first_second, true_offset(submaps, 1, 1))
    assert mm < 3.0
    assert deg < 0.1


def test_the_coarser_image_says_how_far_matches_may_be_off(submaps: Scene, monkeypatch):
    """A pixel of an image of a third of the size is three pixels of the larger one."""
    keyframe = submaps.target.keyframes[1]
    large = keyframe.camera.scaled(3.0, 3.0, 480, 360)
    first, second = seen_by(keyframe, large), keyframe
    matched = match_features(first, second)
    assert matched is not None
    assert matched.pixel_size == pytest.approx(3.0)
    monkeypatch.setattr(matching, "_TOLERANCE_RAD", 0.0)
    monkeypatch.setattr(matching, "_TOLERANCE_DEPTH", 1.0)
    inliers = matched.inliers(np.eye(4)[None])[0]
    closer = replace(matched, pixel_size=1.0).inliers(np.eye(4)[None])[0]
    assert inliers.mean() > 0.9 > closer.mean()


def test_matches_may_be_off_by_one_and_a_half_coarse_pixels(monkeypatch):
    camera = Camera(100.0, 100.0, 50.0, 40.0, 101, 81)
    points = np.array([[0.0, 0.0, 2.0], [0.1, -0.2, 1.5]])
    monkeypatch.setattr(matching, "_TOLERANCE_RAD", 1e-6)
    for off_px, expected in ((2.9, True), (3.1, False)):
        pixels = camera.project(points) + np.array([off_px, 0.0])
        matched = Matched(points, points, pixels, camera, pixel_size=2.0)
        assert (matched.inliers(np.eye(4)[None]) == expected).all()


def test_poses_play_no_part(submaps: Scene):
    first, second = submaps.target.keyframes[1], submaps.source.keyframes[1]
    lost = replace(second, T_map_camera=motion(3, 5.0, 90.0))
    a, b = measure_offset(first, second), measure_offset(first, lost)
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.T_first_second, b.T_first_second)


def test_the_same_seed_gives_the_same_bits(submaps: Scene):
    first, second = submaps.target.keyframes[0], submaps.source.keyframes[2]
    a, b = (measure_offset(first, second, generator=np.random.default_rng(7)) for _ in range(2))
    assert a is not None
    assert b is not None
    assert a.T_first_second.tobytes() == b.T_first_second.tobytes()
    assert a.information.tobytes() == b.information.tobytes()


def test_another_place_has_no_offset(submaps: Scene, stranger):
    assert measure_offset(submaps.target.keyframes[0], stranger) is None


def test_a_blank_or_blind_image_has_no_offset(submaps: Scene):
    keyframe = submaps.target.keyframes[0]
    blank = replace(keyframe, rgb=torch.full_like(keyframe.rgb, 128))
    blind = replace(keyframe, depth_m=torch.zeros_like(keyframe.depth_m))
    assert measure_offset(keyframe, blank) is None
    assert measure_offset(keyframe, blind) is None


@few
@given(seeds)
def test_fits_are_exact_and_never_mirror(seed):
    generator = np.random.default_rng(seed)
    second = generator.normal(size=(4, 3, 3))
    truth = np.array([motion(seed + k, 2.0, 170.0) for k in range(4)])
    first = np.array([se3.transform_points(T, p) for T, p in zip(truth, second, strict=True)])
    found = rigid_fits(first, second)
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1.0)
    moved = np.einsum("hij,hnj->hni", found[:, :3, :3], second) + found[:, None, :3, 3]
    np.testing.assert_allclose(moved, first, atol=1e-9)


@few
@given(seeds)
def test_wrong_matches_are_left_out(seed):
    camera, generator = Camera(262.0, 262.0, 159.5, 119.5, 320, 240), np.random.default_rng(seed)
    T = motion(seed, 0.3, 15.0)
    second = generator.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (80, 3))
    first = se3.transform_points(T, second)
    first[:40] = generator.permutation(first[:40])
    matched = Matched(first, second, camera.project(first), camera)
    found = matched.motion(generator, matching.MIN_MATCHES)
    assert found is not None
    np.testing.assert_allclose(found[0], T, atol=1e-2)
    assert 38 <= found[1] <= 50


def test_an_offset_across_a_real_recording(real_data):
    """Out and back along a kitchen: views of one place, a hundred frames apart."""
    dataset = open_dataset("seven-scenes", real_data("7scenes_redkitchen"), (320, 240), 200)
    truth = dataset.ground_truth.T_world_camera
    last = len(dataset) - 1
    T_last_world = se3.inverse(truth[last])
    near = min(range(80), key=lambda i: float(np.linalg.norm(se3.log(T_last_world @ truth[i]))))
    first, second = (Keyframe.from_frame(dataset[i], np.eye(4)) for i in (near, last))
    offset = measure_offset(first, second)
    assert offset is not None
    mm, deg = error(offset.T_first_second, se3.inverse(truth[near]) @ truth[last])
    assert mm < 40.0  # the truth itself is good to one or two centimetres
    assert deg < 1.5


def test_keypoints_of_the_keyframes_used_last_are_kept(monkeypatch):
    frames, _ = tiny_room(3, 64, 48)
    keyframes = [Keyframe.from_frame(frame, np.eye(4)) for frame in frames]
    detected = []
    detect = matching.keyframe_keypoints

    def counted(keyframe: Keyframe) -> Keypoints:
        detected.append(keyframe.index)
        return detect(keyframe)

    monkeypatch.setattr(matching, "keyframe_keypoints", counted)
    cache = matching.KeypointCache(size=2)
    for n in (0, 1, 0, 2, 0, 1):
        np.testing.assert_array_equal(cache(keyframes[n]).px, detect(keyframes[n]).px)
    assert detected == [0, 1, 2, 1]


@few
@given(seeds, st.floats(0.01, 100.0))
def test_similarities_are_recovered(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    T, second = se3.exp(rng.normal(size=6)), rng.normal(size=(4, 5, 3))
    fits = similarity_fits(scale * second @ T[:3, :3].T + T[:3, 3], second)
    for fit in fits:
        np.testing.assert_allclose(fit[:3, :3], scale * T[:3, :3], atol=1e-9 * scale)
        np.testing.assert_allclose(fit[:3, 3], T[:3, 3], atol=1e-9 * max(scale, 1.0))
