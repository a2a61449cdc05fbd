"""Stage 2 of the refinement: a displaced submap returns to its place in the joint map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from registered_room import QUICK, error, motion, scene

from toolkit.base.geometry import se3
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.refinement import anchors as anchors_module
from toolkit.slam.refinement.anchors import align_anchors, motion_gradient
from toolkit.slam.submaps.atlas import Atlas


def displaced(T_error: np.ndarray) -> tuple[Atlas, np.ndarray]:
    """An atlas of two submaps, the second one away from its true anchor; and that anchor."""
    room = scene((0, 8), (12, 4))
    target = replace(room.target, T_world_submap=motion(3, 1.0, 40.0))
    T_true = target.T_world_submap @ room.T_target_source
    atlas = Atlas(target)
    atlas.start(replace(room.source, T_world_submap=T_true @ T_error))
    atlas.store_active()
    return atlas, T_true


def test_displaced_submap_returns_to_its_place(monkeypatch):
    monkeypatch.setattr(anchors_module, "_ITERATIONS", 4)
    monkeypatch.setattr(anchors_module, "_TRANSLATION_RATE_M", 2e-3)
    monkeypatch.setattr(anchors_module, "_ROTATION_RATE_RAD", 1e-3)
    atlas, T_true = displaced(motion(1, 0.015, 0.6))
    first = atlas.T_world_submap(0)
    before_mm, before_deg = error(atlas.T_world_submap(1), T_true)
    align_anchors(atlas, Mapper(replace(QUICK, centred=False)), [(0, 1)])
    after_mm, after_deg = error(atlas.T_world_submap(1), T_true)
    assert after_mm < 0.6 * before_mm
    assert after_deg < 0.6 * before_deg
    assert np.array_equal(atlas.T_world_submap(0), first)


def test_parts_and_loaded_submaps_are_not_aligned():
    atlas, _ = displaced(motion(1, 0.015, 0.6))
    before = atlas.T_world_submap(1)
    align_anchors(atlas, Mapper(QUICK), [(0,), (1,)])
    assert np.array_equal(atlas.T_world_submap(1), before)
    atlas.saved = 2
    align_anchors(atlas, Mapper(QUICK), [(0, 1)])
    assert np.array_equal(atlas.T_world_submap(1), before)


def test_motion_gradient_agrees_with_finite_differences():
    generator = np.random.default_rng(0)
    points, weights = generator.normal(size=(2, 20, 3))
    gradient = motion_gradient(points, weights)
    for axis in range(6):
        x = np.zeros(6)
        x[axis] = 1e-6
        ahead, behind = (
            (se3.transform_points(se3.exp(sign * x), points) * weights).sum() for sign in (1, -1)
        )
        assert (ahead - behind) / 2e-6 == pytest.approx(gradient[axis], rel=1e-6)
