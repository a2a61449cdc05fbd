"""Depth priors that are not what is declared, found by points whose depth is known."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.depth.depth_priors.kind_check import KnownDepths, prior_doubt
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    PixelMapping,
    PriorModel,
    ScaleScope,
)

Array = NDArray[np.float64]

WIDTH, HEIGHT, KEYFRAMES, OPTION = 80, 60, 6, "--values"


def scene(number: int) -> Array:
    """Depth of a keyframe: some surfaces between 1 and 4 m."""
    random = np.random.default_rng(number)
    coarse = random.uniform(0.0, 1.4, (4, 5))
    return np.asarray(np.exp(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)))


def points(number: int) -> KnownDepths:
    """Triangulated points of a keyframe, in an arbitrary unit, a few of them wrong."""
    random = np.random.default_rng(100 + number)
    pixels = random.uniform(0.0, [WIDTH - 1, HEIGHT - 1], (150, 2))
    column, row = np.rint(pixels).astype(int).T
    depths = 0.3 * scene(number)[row, column] * (1.0 + 0.02 * random.standard_normal(150))
    depths[:10] *= 2.0
    return KnownDepths(pixels, depths)


def doubt(maps: Callable[[int], Array], kind: DepthKind, option: str | None = OPTION) -> str | None:
    scope, model = ScaleScope.FRAME, PriorModel("maps")
    priors = [
        DepthPrior(np.ascontiguousarray(maps(n), np.float32), kind, scope, model)
        for n in range(KEYFRAMES)
    ]
    return prior_doubt(priors, [points(n) for n in range(KEYFRAMES)], option)


def noisy(values: Array, share: float) -> Array:
    return values * (1.0 + share * np.random.default_rng(5).standard_normal(values.shape))


def of_other_images(number: int) -> Array:
    return scene((number + 2) % KEYFRAMES)


RIGHT = {
    "metric": (scene, DepthKind.METRIC),
    "metric, 10 % of noise": (lambda n: noisy(scene(n), 0.1), DepthKind.METRIC),
    "metric, 25 % of noise": (lambda n: noisy(scene(n), 0.25), DepthKind.METRIC),
    "metric, with an offset": (lambda n: scene(n) + 0.2, DepthKind.METRIC),
    "scaled": (lambda n: (1 + n) * scene(n), DepthKind.SCALED),
    "affine": (lambda n: 0.5 * scene(n) + 2.0, DepthKind.AFFINE),
    "inverse": (lambda n: 1.0 / scene(n), DepthKind.AFFINE_INVERSE),
    "inverse and shifted": (lambda n: 3.0 / scene(n) - 0.5 * n, DepthKind.AFFINE_INVERSE),
    "inverse, noise": (lambda n: noisy(2.0 / scene(n), 0.1) + 1.0, DepthKind.AFFINE_INVERSE),
}


@pytest.mark.parametrize("name", RIGHT)
def test_priors_that_are_what_they_are_declared_as_raise_no_doubt(name: str) -> None:
    assert doubt(*RIGHT[name]) is None


@pytest.mark.parametrize(
    ("maps", "declared", "remedy"),
    [
        (lambda n: 1.0 / scene(n), DepthKind.METRIC, f"use {OPTION} affine-inverse"),
        (lambda n: noisy(1.0 / scene(n), 0.1), DepthKind.SCALED, f"use {OPTION} affine-inverse"),
        (lambda n: 5.0 - 2.0 * scene(n), DepthKind.METRIC, "inverse depth"),
        (scene, DepthKind.AFFINE_INVERSE, f"use {OPTION} scaled"),
        (lambda n: scene(n) + 4.0, DepthKind.AFFINE_INVERSE, f"use {OPTION} affine"),
        (lambda n: scene(n) + 9.0, DepthKind.METRIC, f"use {OPTION} affine"),
        (lambda n: np.log(scene(n)) + 0.1, DepthKind.METRIC, "the logarithm of depth; write maps"),
    ],
)
def test_another_kind_is_named(
    maps: Callable[[int], Array], declared: DepthKind, remedy: str
) -> None:
    found = doubt(maps, declared)
    assert found is not None
    assert f"declared as {declared.value}, but" in found
    assert remedy in found


@pytest.mark.parametrize(
    ("maps", "hint"),
    [
        (of_other_images, "those of other images agree better"),
        (lambda n: scene(n)[:, ::-1], "they are mirrored"),
        (lambda n: scene(n)[::-1], "they are upside down"),
        (lambda n: 1.0 + np.random.default_rng(n).random((HEIGHT, WIDTH)), "check that the maps"),
        (lambda n: np.full((HEIGHT, WIDTH), 2.0), "check that the maps"),
    ],
)
@pytest.mark.parametrize("kind", [DepthKind.METRIC, DepthKind.AFFINE])
def test_priors_of_other_images_contradict_the_motion(
    maps: Callable[[int], Array], hint: str, kind: DepthKind
) -> None:
    found = doubt(maps, kind)
    assert found is not None
    assert "contradict the motion" in found
    assert hint in found


def test_without_an_option_no_remedy_is_named() -> None:
    found = doubt(lambda n: 1.0 / scene(n), DepthKind.METRIC, None)
    assert found is not None
    assert found.endswith("they are inverse depth")


def test_maps_of_another_size_are_compared_at_the_right_pixels() -> None:
    scale = PixelMapping.resize((WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2))
    values = [cv2.resize(scene(n), (WIDTH // 2, HEIGHT // 2)).astype(np.float32) for n in range(6)]
    priors = [
        DepthPrior(v, DepthKind.METRIC, ScaleScope.FRAME, PriorModel("maps"), scale) for v in values
    ]
    assert prior_doubt(priors, [points(n) for n in range(KEYFRAMES)], OPTION) is None


def test_a_wall_in_front_of_the_camera_says_nothing() -> None:
    wall = [KnownDepths(points(n).pixels, np.full(150, 2.0)) for n in range(KEYFRAMES)]
    values = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    prior = DepthPrior(values, DepthKind.METRIC, ScaleScope.FRAME, PriorModel("maps"))
    assert prior_doubt([prior] * KEYFRAMES, wall, OPTION) is None
    assert prior_doubt([prior] * 3, [points(n) for n in range(3)], OPTION) is None
