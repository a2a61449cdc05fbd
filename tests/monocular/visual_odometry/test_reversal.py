"""Structure that is turned inside out."""

from __future__ import annotations

import numpy as np
import pytest
from test_scale_drift import sparse_map

from toolkit.base.geometry import se3
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions
from toolkit.depth.monocular.visual_odometry import reversal
from toolkit.depth.monocular.visual_odometry.reversal import without_reversal
from toolkit.depth.monocular.visual_odometry.sparse_map import SparseMap
from toolkit.semantics.features.tracks import Features

VIEWS, NOISE_PX = 9, 0.2
# Landmarks are shown by few views, as where a camera turns.
SHOWN = 4
WINDOW, FREE = range(VIEWS), range(2, VIEWS)
THOROUGHLY = BundleOptions(iterations=60)


def turning() -> np.ndarray:
    """Poses [N, 4, 4] of a camera that turns by 8 degrees and moves by 4 cm from view to view."""
    poses = np.array([se3.exp([0.0, 0.0, 0.0, 0.0, 0.14 * n, 0.0]) for n in range(VIEWS)])
    for n, T in enumerate(poses):
        T[:3, 3] = 0.04 * n * np.array([np.cos(0.07 * n), 0.0, -np.sin(0.07 * n)])
    return poses


@pytest.fixture
def upright() -> SparseMap:
    rng = np.random.default_rng(1)
    angle, height = rng.uniform(-0.6, 1.8, 700), rng.uniform(-0.8, 0.8, 700)
    distance = rng.uniform(1.6, 2.4, 700)
    points = np.stack([distance * np.sin(angle), height, distance * np.cos(angle)], 1)
    made = sparse_map(turning(), points)
    for number, view in enumerate(made.views):
        new = number - made.table.anchor[view.features.ids] < SHOWN
        shown = view.features.select(new)
        view.features = Features(shown.ids, shown.px + rng.normal(0.0, NOISE_PX, shown.px.shape))
    made.adjust(WINDOW, FREE, THOROUGHLY, clean=False)
    return made


@pytest.fixture
def inside_out(upright) -> SparseMap:
    """The other minimum of the bundle adjustment."""
    found = reversal._mirrored(upright, VIEWS - 6)
    assert found is not None
    found.adjust(WINDOW, FREE, THOROUGHLY, clean=False)
    return found


def worst_turn_deg(found: SparseMap) -> float:
    """Largest error of the rotation between consecutive views."""
    errors = []
    for n in range(VIEWS - 1):
        T = reversal._relative(found.views[n], found.views[n + 1])
        true = se3.inverse(turning()[n]) @ turning()[n + 1]
        errors.append(se3.rotation_angle_rad(T[:3, :3].T @ true[:3, :3]))
    return float(np.degrees(max(errors)))


def test_structure_that_is_inside_out_is_turned_back(inside_out):
    assert worst_turn_deg(inside_out) > 1.5
    found = without_reversal(inside_out, WINDOW, FREE)
    assert found is not inside_out
    assert worst_turn_deg(found) < 0.3


def test_true_structure_remains(upright):
    assert worst_turn_deg(upright) < 0.3
    assert without_reversal(upright, WINDOW, FREE) is upright
