"""A depth prior of known scale and shift: true depth, degraded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset
from toolkit.depth.depth_priors.alignment import ScaleShift
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    Image,
    PriorModel,
    PriorSet,
    ScaleScope,
    frame_sets,
)


@dataclass(frozen=True)
class Degradation:
    """What a prior does to true depth.

    Attributes:
        noise: standard deviation relative to the depth, independent between pixels.
        outliers: fraction of the pixels with any depth up to three times the median.
        bend: RMS of a smooth factor on the depth, which differs between frames.
    """

    noise: float
    outliers: float
    bend: float = 0.0


class DegradedDepth:
    """True depth with an unknown scale and shift per set of frames, noise and outliers.

    The first set has the scale 1 and the shift 0.

    Args:
        dataset: with true depth.
        size, stride: of the sets.
        seed: of all random values.
    """

    joint = False
    model = PriorModel("degraded true depth", licence="none")

    def __init__(
        self, dataset: Dataset, degradation: Degradation, size: int, stride: int, seed: int
    ) -> None:
        self._dataset, self._degradation, self._seed = dataset, degradation, seed
        sets = frame_sets(len(dataset), size, stride)
        self._set_of = {index: n for n, members in enumerate(sets) for index in members}

    def truth(self, number: int) -> ScaleShift:
        """The correction of a set: depth = scale * value + shift, in metres."""
        if number == 0:
            return ScaleShift(1.0)
        rng = np.random.default_rng((self._seed, 0, number))
        return ScaleShift(float(np.exp(rng.uniform(-0.7, 0.7))), float(rng.uniform(-0.4, 0.4)))

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        """Degraded depth of some frames."""
        priors = tuple(
            DepthPrior(self._values(f.index), DepthKind.AFFINE, ScaleScope.SET, self.model)
            for f in frames
        )
        return PriorSet(tuple(f.index for f in frames), priors)

    def _values(self, index: int) -> Image:
        depth = self._dataset[index].depth_m.astype(np.float64)
        rng, how = np.random.default_rng((self._seed, 1, index)), self._degradation
        true = self.truth(self._set_of[index])
        values = (depth * _bend(depth.shape, how.bend, rng) - true.shift) / true.scale
        values *= 1.0 + how.noise * rng.standard_normal(depth.shape)
        wrong = rng.uniform(0.0, 3.0, depth.shape) * np.median(values[depth > 0])
        values = np.where(rng.random(depth.shape) < how.outliers, wrong, values)
        return np.where(depth > 0, values, np.nan).astype(np.float32)


def _bend(shape: tuple[int, ...], rms: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth factor [H, W] of mean 1: waves of half to one period across the image."""
    y, x = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in shape), indexing="ij")
    periods, phase = rng.uniform(-1.0, 1.0, 2), rng.uniform(0.0, 2.0 * np.pi)
    wave = np.cos(2.0 * np.pi * (periods[0] * x + periods[1] * y) + phase)
    return np.asarray(1.0 + rms * np.sqrt(2.0) * (wave - wave.mean()))
