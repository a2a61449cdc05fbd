"""Correction of priors with rendered depth: sets, the unit of length, failures, state."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.correction import DepthCorrection, RenderedDepth
from toolkit.depth.depth_priors.options import ScaleCorrectionOptions
from toolkit.depth.depth_priors.outliers import without_outliers
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    PriorImage,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.depth_priors.source import FramePrior, PriorSource

SHAPE = (60, 80)
CAMERA = Camera(70.0, 70.0, 39.5, 29.5, 80, 60)
TRUTH = np.broadcast_to(np.linspace(1.0, 4.0, 80, dtype=np.float32), SHAPE).copy()
OPAQUE = np.ones(SHAPE, np.float32)
# Scale and shift by set; sets are of two frames.
SETS = [(1.0, 0.0), (0.5, 0.3), (2.0, -0.2)]


def frame(index: int, depth_m: np.ndarray | None = None) -> Frame:
    depth_m = np.zeros(SHAPE, np.float32) if depth_m is None else depth_m
    return Frame(index, float(index), np.zeros((*SHAPE, 3), np.float32), depth_m, CAMERA)


def prior_of(index: int, noise: float = 0.0) -> FramePrior:
    scale, shift = SETS[index // 2]
    rng = np.random.default_rng(index)
    values = (TRUTH - shift) / scale * (1.0 + noise * rng.standard_normal(SHAPE))
    values = values.astype(np.float32)
    model = PriorModel("known")
    image = PriorImage(values, np.ones(SHAPE, bool), DepthKind.AFFINE)
    return FramePrior(
        image, index // 2, DepthPrior(values, DepthKind.AFFINE, ScaleScope.SET, model)
    )


def correction(prior=prior_of, reference: bool = False, **options) -> DepthCorrection:
    return DepthCorrection(prior, ScaleCorrectionOptions(**options), needs_reference=reference)


def rendered(depth_m: np.ndarray = TRUTH, silhouette: np.ndarray = OPAQUE) -> RenderedDepth:
    return RenderedDepth(depth_m.astype(np.float32), silhouette)


def test_the_first_set_fixes_the_unit_of_length():
    fixed = correction()
    start = fixed.start(frame(0))
    assert np.allclose(start.depth_m, TRUTH)
    # The map's depth is not used for the first set, even if it drifted.
    assert np.allclose(fixed.correct(frame(1), rendered(1.1 * TRUTH)).depth_m, TRUTH, rtol=0.05)
    assert fixed.found[0].scale == 1.0


@pytest.mark.parametrize("index", [2, 4])
def test_other_sets_are_aligned_with_the_map(index):
    known = correction()
    known.start(frame(0))
    found = known.correct(frame(index), rendered())
    assert np.allclose(found.depth_m, TRUTH, rtol=1e-3)
    scale, shift = SETS[index // 2]
    assert known.found[index // 2].scale == pytest.approx(scale, rel=1e-3)
    assert known.found[index // 2].shift == pytest.approx(shift, abs=1e-3)


def test_only_opaque_pixels_are_compared():
    known = correction()
    known.start(frame(0))
    wrong, silhouette = TRUTH.copy(), OPAQUE.copy()
    wrong[:, 50:], silhouette[:, 50:] = 9.0, 0.5
    found = known.correct(frame(2), rendered(wrong, silhouette))
    assert np.allclose(found.depth_m, TRUTH, rtol=1e-3)


def test_known_depth_sets_the_unit_where_poses_have_another():
    other = correction(reference=True)
    assert not other.start(frame(0)).depth_m.any()
    half = other.start(frame(2, (0.5 * TRUTH).astype(np.float32)))
    assert np.allclose(half.depth_m, 0.5 * TRUTH, rtol=1e-3)
    assert other.found[1].scale == pytest.approx(0.25, rel=1e-3)


def test_frames_of_a_set_share_scale_and_shift():
    """The second frame sees too little of the map for an estimate of its own."""
    shared, single = correction(), correction(share="frame")
    little = np.zeros(SHAPE, np.float32)
    little[0, :20] = 1.0
    for each in (shared, single):
        each.start(frame(0))
        each.correct(frame(2), rendered())
    assert np.allclose(shared.correct(frame(3), rendered(TRUTH, little)).depth_m, TRUTH, rtol=0.01)
    assert set(shared.found) == {0, 1}
    single.correct(frame(3), rendered(TRUTH, little))
    assert 3 not in single.found


def test_without_any_overlap_the_last_correction_is_used():
    known = correction()
    known.start(frame(0))
    nothing = np.zeros(SHAPE, np.float32)
    found = known.correct(frame(2), rendered(TRUTH, nothing))
    assert np.allclose(found.depth_m, prior_of(2).image.values)


def test_a_predicted_pose_teaches_the_set_nothing():
    known = correction()
    known.start(frame(0))
    assert known.correct(frame(2), rendered(1.2 * TRUTH), final=False).depth_m.any()
    assert 1 not in known.found and not known.state()[1]["groups"]
    known.correct(frame(2), rendered())
    # The set is known by now, and a wrong prediction does not change the depth.
    moved = known.correct(frame(3), rendered(TRUTH + 0.3), final=False)
    assert np.allclose(moved.depth_m, TRUTH, rtol=1e-3)


def test_without_sets_the_depth_follows_a_wrong_prediction():
    """H-16 as printed: what is aligned at the predicted pose agrees with it."""
    single = correction(share="frame", robust=False, filter=False, grid=1)
    single.start(frame(0))
    moved = single.correct(frame(3), rendered(TRUTH + 0.3), final=False)
    assert np.allclose(moved.depth_m, TRUTH + 0.3, rtol=1e-3)


@pytest.mark.parametrize("kind", [DepthKind.SCALED, DepthKind.AFFINE_INVERSE])
@pytest.mark.parametrize("unit", [0.01, 100.0])
def test_a_first_prior_of_unknown_scale_gets_the_size_of_a_room(kind, unit):
    values = unit * TRUTH if kind is DepthKind.SCALED else 1.0 / (unit * TRUTH)
    image = PriorImage(values.astype(np.float32), np.ones(SHAPE, bool), kind)
    prior = FramePrior(image, 0, prior_of(0).prior)
    first = correction(lambda index: prior)
    depth_m = first.start(frame(0)).depth_m
    assert np.median(depth_m) == pytest.approx(2.0, rel=1e-3)
    assert np.allclose(depth_m / depth_m[0, 0], TRUTH / TRUTH[0, 0], rtol=1e-4)
    assert not first.metric


def test_a_metric_prior_keeps_the_metre():
    image = PriorImage(20.0 * TRUTH, np.ones(SHAPE, bool), DepthKind.METRIC)
    first = correction(lambda index: FramePrior(image, 0, prior_of(0).prior))
    assert np.allclose(first.start(frame(0)).depth_m, 20.0 * TRUTH)
    arrays, values = first.state()
    again = correction()
    again.restore(arrays, json.loads(json.dumps(values)))
    assert first.metric and again.metric


def test_plain_least_squares_is_the_printed_equation():
    noisy = lambda index: prior_of(index, 0.2)  # noqa: E731
    plain = correction(noisy, robust=False, filter=False, grid=1)
    plain.start(frame(0))
    plain.correct(frame(2), rendered())
    values = noisy(2).image.values.reshape(-1).astype(np.float64)
    scale, shift = np.polyfit(values, TRUTH.reshape(-1), 1)
    assert plain.found[1].scale == pytest.approx(scale, rel=1e-4)
    assert plain.found[1].shift == pytest.approx(shift, rel=1e-4)
    robust = correction(noisy)
    robust.start(frame(0))
    robust.correct(frame(2), rendered())
    assert abs(robust.found[1].scale - 0.5) < 0.5 * abs(scale - 0.5)


def test_a_restored_correction_continues_identically():
    def continued(corrections: DepthCorrection) -> bytes:
        return corrections.correct(frame(3), rendered(1.01 * TRUTH)).depth_m.tobytes()

    original = correction(lambda index: prior_of(index, 0.1))
    original.start(frame(0))
    original.correct(frame(2), rendered())
    arrays, values = original.state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    values = json.loads(json.dumps(values))
    other = correction(lambda index: prior_of(index, 0.1))
    other.restore(arrays, values)
    assert continued(other) == continued(original)
    assert other.found == original.found


def test_smooth_priors_are_not_filtered():
    image = prior_of(2).image
    assert without_outliers(image) is image


def test_noise_and_outliers_of_priors_are_filtered():
    rng = np.random.default_rng(0)
    image = prior_of(0, 0.2).image
    wrong = rng.random(SHAPE) < 0.3
    values = np.where(wrong, rng.uniform(0.0, 8.0, SHAPE), image.values).astype(np.float32)
    known = np.ones(SHAPE, bool)
    known[:5] = False
    filtered = without_outliers(PriorImage(values, known, DepthKind.SCALED))
    error = np.abs(filtered.values / TRUTH - 1.0)[10:-10, 10:-10]
    assert np.median(error) < 0.04
    assert (error > 0.2).mean() < 0.02
    assert not filtered.known[:5].any()


class Counting:
    """A provider that records what it is asked for."""

    model = PriorModel("counting")

    def __init__(self, joint: bool) -> None:
        self.joint, self.calls = joint, []

    def predict(self, frames):
        self.calls.append(tuple(f.index for f in frames))
        return PriorSet(self.calls[-1], tuple(prior_of(0).prior for _ in frames))


@pytest.mark.parametrize(("joint", "calls"), [(True, [(0, 2)]), (False, [(0,), (2,)])])
def test_images_are_predicted_in_sets_if_the_model_prefers_that(joint, calls):
    provider = Counting(joint)
    source = PriorSource(provider, frame, range(4), size=2, stride=2)
    groups = [source.prior(index).group for index in (0, 2, 0)]
    assert provider.calls == calls
    assert groups == [0, 0, 0]
