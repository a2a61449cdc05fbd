"""Registration of two maps: submap pairs and selection of the result."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.result import RegistrationResult, failed
from toolkit.slam.loops.two_maps import (
    MapRegistration,
    SubmapPair,
    most_similar_submaps,
    register_submaps,
    select_registration,
)
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import ResidualScales
from toolkit.splatting.gaussians.cloud import GaussianCloud


def submap(number, rows, T_world_submap=None):
    rows = np.array(rows, np.float32).reshape(-1, 2)
    T = np.eye(4) if T_world_submap is None else T_world_submap
    return Submap(number, T, GaussianCloud.empty(), [], descriptors=rows)


def unit(*degrees):
    return [[np.cos(np.radians(d)), np.sin(np.radians(d))] for d in degrees]


def test_most_similar_pairs_come_first():
    first = {0: submap(0, unit(0, 5)), 2: submap(2, unit(90, 95))}
    second = {0: submap(0, unit(93)), 1: submap(1, unit(40, 41))}
    pairs = most_similar_submaps(first, second, 9)
    assert [(p.first, p.second) for p in pairs] == [(2, 0), (0, 1), (2, 1), (0, 0)]
    # 93 degrees lies 3 from 90, and 2 from 95.
    chords = [2 * np.sin(np.radians(d) / 2) for d in (2, 3)]
    assert pairs[0].distance == pytest.approx(np.mean(chords), abs=1e-3)
    assert most_similar_submaps(first, second, 2) == pairs[:2]


def test_submaps_without_descriptors_are_skipped():
    first = {0: submap(0, []), 1: submap(1, unit(0))}
    (pair,) = most_similar_submaps(first, {0: submap(0, unit(10))}, 9)
    assert (pair.first, pair.second) == (1, 0)


def result(T, overlap=0.7):
    scales = ResidualScales(0.02, 0.003)
    information = np.eye(6) * 1e8
    return RegistrationResult(
        T, True, 0.95, scales, overlap, float("nan"), information, 1, 1, "test"
    )


def test_map_transformation_is_composed_from_submap_poses():
    T_a, T_b, T_ab = (se3.exp(np.arange(6) * 0.1 + k) for k in (0.0, 0.3, -0.2))

    class Registrar:
        def register(self, target, source, T_target_source=None):
            assert T_target_source is None
            return result(T_ab)

    found = register_submaps(
        SubmapPair(0, 0, 0.1),
        {0: submap(0, unit(0), T_a)},
        {0: submap(0, unit(0), T_b)},
        Registrar(),
    )
    assert not found.reason
    assert np.allclose(found.T_first_second, T_a @ T_ab @ se3.inverse(T_b))


def registration(metres, overlap=0.7, reason=""):
    T = se3.exp(np.array([metres, 0, 0, 0, 0, 0.0]))
    return MapRegistration(SubmapPair(0, 0, 0.1), result(T, overlap), reason, T)


def test_majority_is_selected_then_the_larger_overlap():
    outlier = registration(9.0, overlap=0.99)
    two = [registration(1.0, 0.5), registration(1.1, 0.6)]
    selection = select_registration([outlier, *two])
    assert selection.best is two[1] and (selection.verified, selection.agreeing) == (3, 2)
    assert select_registration([outlier, registration(1.0)]).best is outlier


def test_rejected_registrations_have_no_vote():
    rejected = [registration(1.0, reason="no"), registration(1.0, reason="no")]
    kept = registration(5.0)
    assert select_registration([*rejected, kept]).best is kept
    assert select_registration(rejected) is None
    assert select_registration([]) is None


def test_failed_registration_reports_its_reason():
    class Nothing:
        def register(self, target, source, T_target_source=None):
            return failed("test", "nothing in common")

    maps = {0: submap(0, unit(0))}
    found = register_submaps(SubmapPair(0, 0, 0.1), maps, maps, Nothing())
    assert found.reason == "nothing in common"
