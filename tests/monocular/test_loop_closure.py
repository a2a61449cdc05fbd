"""Monocular maps are corrected by places that the camera visits again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from moving_camera import error_m, film, walk

from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.monocular.loop_closure import close_loops
from toolkit.depth.monocular.revisits import NEAR, find_keypoints, find_revisits
from toolkit.depth.monocular.visual_odometry.odometry import VisualOdometry
from toolkit.depth.monocular.visual_odometry.sparse_map import SparseMap
from toolkit.splatting.alignment.levels import intensity_of

OUT = 12
TRUTH = np.concatenate([walk(OUT), walk(OUT)[::-1]])

Image = Callable[[int], np.ndarray]


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """A walk there and back."""
    return [np.round(255 * intensity_of(f.rgb).numpy()).astype(np.uint8) for f in film(TRUTH)]


@pytest.fixture(scope="module")
def followed(images) -> SparseMap:
    odometry = VisualOdometry(film(TRUTH[:1])[0].camera)
    for image in images:
        odometry.process(image)
    odometry.map.adjust_all()
    return odometry.map


def drifted(sparse_map: SparseMap, factor: float) -> SparseMap:
    """The same map with a scale that changes by a factor from view to view."""
    found = sparse_map.copy()
    scale = factor ** np.arange(len(found.views))
    poses = [view.T_world_camera.copy() for view in found.views]
    for n in range(1, len(poses)):
        step = sparse_map.views[n].T_world_camera - sparse_map.views[n - 1].T_world_camera
        poses[n][:3, 3] = poses[n - 1][:3, 3] + scale[n] * step[:3, 3]
    found.transform(poses, scale)
    return found


def rms_m(sparse_map: SparseMap) -> float:
    poses = np.array([sparse_map.T_world_camera(n) for n in range(len(TRUTH))])
    return error_m(Trajectory(np.arange(len(TRUTH)) / 30.0, poses), TRUTH)[0]


def test_the_way_back_revisits_the_way_there(followed, images):
    keypoints = find_keypoints(followed.camera, followed.views, lambda n: images[n])
    revisits = find_revisits(followed.camera, keypoints)
    assert len(revisits) > 5
    for revisit in revisits:
        assert revisit.second - revisit.first > NEAR
        assert revisit.scale == pytest.approx(1.0, abs=0.1)


def test_drift_in_scale_is_corrected(followed, images):
    drifting = drifted(followed, 1.15)
    before = rms_m(drifting)
    corrected, loops = close_loops(drifting, lambda n: images[n])
    assert before > 0.04
    assert rms_m(corrected) < 0.25 * before
    assert loops.revisits > 5
    # Bundle adjustment has changed the unit of length, too.
    assert loops.rejected == 0
    # The argument is unchanged.
    assert rms_m(drifting) == before


def test_a_good_map_remains_good(followed, images):
    corrected, loops = close_loops(followed, lambda n: images[n])
    assert loops.revisits > 5
    assert rms_m(corrected) < max(1.2 * rms_m(followed), 0.01)


def test_places_that_only_look_alike_are_rejected():
    """The end of a walk shows what the beginning has shown, but the walk did not lead back."""
    frames = film(walk(24))
    images = [np.round(255 * intensity_of(f.rgb).numpy()).astype(np.uint8) for f in frames]
    odometry = VisualOdometry(frames[0].camera)
    for image in images:
        odometry.process(image)
    odometry.map.adjust_all()
    keyframes = [view.frame for view in odometry.map.views]
    shown = dict(zip(keyframes[-5:], keyframes[:5], strict=True))
    corrected, loops = close_loops(odometry.map, lambda n: images[shown.get(n, n)])
    assert loops.rejected > 0
    positions, before = (
        np.array([view.T_world_camera[:3, 3] for view in found.views])
        for found in (corrected, odometry.map)
    )
    np.testing.assert_allclose(positions, before, atol=0.02)


def test_the_result_is_reproducible(followed, images):
    first, second = (close_loops(drifted(followed, 1.15), lambda n: images[n]) for _ in range(2))
    for a, b in zip(first[0].views, second[0].views, strict=True):
        assert a.T_world_camera.tobytes() == b.T_world_camera.tobytes()
    assert first[1] == second[1]


def test_images_without_keypoints_change_little(followed):
    blank = np.full((120, 160), 100, np.uint8)
    corrected, loops = close_loops(followed, lambda n: blank)
    assert (loops.revisits, loops.rejected) == (0, 0)
    assert rms_m(corrected) == pytest.approx(rms_m(followed), abs=0.01)
