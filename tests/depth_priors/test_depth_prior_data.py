"""Depth priors: kinds, masks, mapping back to the pixels of a frame, sets of frames."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.provider import (
    Confidence,
    DepthKind,
    DepthPrior,
    PixelMapping,
    PriorModel,
    PriorSet,
    ScaleScope,
    frame_sets,
)

MODEL = PriorModel("a model", licence="MIT")
FRAME = Camera(100.0, 100.0, 39.5, 29.5, 80, 60)


def prior(values: np.ndarray, **fields) -> DepthPrior:
    usual = {"kind": DepthKind.SCALED, "scope": ScaleScope.SET, "model": MODEL}
    return DepthPrior(values.astype(np.float32), **(usual | fields))


def ramp(camera: Camera) -> np.ndarray:
    """The depth of a slanted plane, as a camera sees it."""
    rays = camera.rays()
    return (2.0 / (1.0 + 0.3 * rays[..., 0] + 0.5 * rays[..., 1])).astype(np.float32)


@pytest.mark.parametrize(
    "mapped",
    [
        FRAME.scaled(2.0, 2.0, 160, 120),
        FRAME.scaled(0.5, 0.5, 40, 30),
        FRAME.scaled(1.5, 1.5, 120, 90).cropped(-4, -8, 140, 106),  # padded
    ],
)
def test_priors_return_to_the_pixels_of_their_frame(mapped):
    image = prior(ramp(mapped), pixels=PixelMapping.between(FRAME, mapped)).in_frame(FRAME.size)
    assert image.known.all()
    assert np.allclose(image.values, ramp(FRAME), rtol=0.01)


def test_pixels_outside_a_crop_have_no_prior():
    crop = FRAME.cropped(10, 5, 60, 50)
    image = prior(ramp(crop), pixels=PixelMapping.between(FRAME, crop)).in_frame(FRAME.size)
    assert image.known.sum() == 60 * 50
    assert image.known[5:55, 10:70].all()
    assert np.array_equal(image.values[5:55, 10:70], ramp(crop))


def test_mappings_can_be_chained():
    resized, cropped = FRAME.scaled(2.0, 2.0, 160, 120), None
    cropped = resized.cropped(6, 4, 140, 110)
    chained = PixelMapping.resize(FRAME.size, resized.size).then(PixelMapping((1, 1), (-6, -4)))
    direct = PixelMapping.between(FRAME, cropped)
    assert np.allclose(chained.scale, direct.scale)
    assert np.allclose(chained.offset, direct.offset)


def test_surfaces_are_not_mixed_at_edges():
    values = np.ones((30, 40))
    values[:, 20:] = 3.0
    image = prior(values, pixels=PixelMapping.resize(FRAME.size, (40, 30))).in_frame(FRAME.size)
    assert set(np.unique(image.values)) == {1.0, 3.0}


def test_what_is_not_usable_is_unknown():
    values = np.ones((60, 80))
    values[0], values[1], values[2] = np.nan, np.inf, -1.0
    mask, confidence = np.ones((60, 80), bool), np.full((60, 80), 2.0, np.float32)
    mask[3] = False
    confidence[4] = 0.5
    marked = prior(values, mask=mask, confidence=Confidence(confidence, 1.0))
    image = marked.in_frame(FRAME.size)
    assert not image.known[:5].any()
    assert image.known[5:].all()
    assert np.array_equal(image.weights[5:], np.ones((55, 80)))
    # Affine values may be negative.
    assert prior(values, kind=DepthKind.AFFINE).in_frame(FRAME.size).known[2].all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"mask": np.ones((3, 3), bool)}, "mask must have shape"),
        ({"confidence": Confidence(np.ones((2, 2), np.float32))}, "confidence must"),
        ({"camera": FRAME}, "camera must have the size"),
    ],
)
def test_sizes_must_agree(fields, message):
    with pytest.raises(ValueError, match=message):
        prior(np.ones((30, 40)), **fields)


def test_a_set_has_one_prior_per_frame():
    with pytest.raises(ValueError, match="2 frames have 1 priors"):
        PriorSet((0, 4), (prior(np.ones((3, 3))),))
    with pytest.raises(ValueError, match="T_first_camera"):
        PriorSet((0,), (prior(np.ones((3, 3))),), np.zeros((2, 4, 4)))


@pytest.mark.parametrize(
    ("count", "size", "stride"), [(64, 8, 4), (70, 8, 4), (5, 3, 1), (3, 8, 4)]
)
def test_sets_contain_every_frame_once_at_the_stride(count, size, stride):
    sets = frame_sets(count, size, stride)
    assert sorted(i for s in sets for i in s) == list(range(count))
    assert all(len(s) <= size and (np.diff(s) == stride).all() for s in sets)
    assert sets[0] == tuple(range(0, min(count, size * stride), stride))
