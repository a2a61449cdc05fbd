"""Scale and shift of depth priors: robustly for a set of images, and smooth across an image.

The values of the prior are explained by the reference (rendered or triangulated depth), `value =
a x + b`, with x = z or 1 / z. Solving for the reference instead, as H-16 does, attributes all noise
to the reference and attenuates the scale: with 20 % noise by a quarter in a room. Scale and shift
of the correction follow: `x = scale value + shift`, scale = 1 / a, shift = -b / a.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.depth.depth_priors.provider import DepthKind, Image, PriorImage

Array = NDArray[np.float64]

# A set is fitted to at most this number of pixels, evenly chosen.
MAX_SAMPLES = 200_000
_MIN_SAMPLES = 30
# The first guess comes from medians in groups of equal reference depth.
_GROUPS = 12
_ROUNDS, _SAME = 80, 1e-6
# Width, in standard deviations of the noise, of the peak that the final estimate is the middle of.
# Outliers that are all on one side of the inliers and reach into their noise bias it less.
_PEAK = 0.5
# Relative error of the reference, and the largest share of the residuals' variance that is
# attributed to it: as much as to the prior.
REFERENCE_NOISE, _MAX_REFERENCE_SHARE = 0.012, 0.5
# Noise is proportional to the value, but not less than this fraction of the median value.
_MIN_RELATIVE = 0.25
_MIN_SIGMA = 1e-4
# Without a larger relative spread of the reference, shift and scale cannot be distinguished.
_MIN_SPREAD = 0.03
# Noise and model errors are correlated: this many pixels count as one observation on the grid.
_CORRELATED_PIXELS = 50.0
# Expected changes from one node of the grid to the next, relative to the scale and to the typical
# value, and of single nodes from the whole image.
_STEP_SCALE, _STEP_SHIFT, _FROM_GLOBAL = 0.15, 0.03, 0.3
# Local scales are limited to this factor around the global one.
_MAX_LOCAL = 2.0


@dataclass(frozen=True)
class Samples:
    """Pixels with both a prior and a reference.

    Attributes:
        values: [N] of the prior. reference: [N] x, z or 1 / z.
        weights: [N] in [0, 1].
        positions: [N, 2] column and row relative to the image, in [0, 1].
    """

    values: Array
    reference: Array
    weights: Array
    positions: Array

    def __len__(self) -> int:
        return len(self.values)

    @classmethod
    def joined(cls, parts: list[Samples]) -> Samples:
        """All samples of several images; at most `MAX_SAMPLES`, evenly chosen."""
        names = ("values", "reference", "weights", "positions")
        joined = cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
        return joined.thinned()

    def thinned(self, count: int = MAX_SAMPLES) -> Samples:
        """At most `count` of the samples, evenly chosen."""
        if len(self) <= count:
            return self
        keep = np.linspace(0, len(self) - 1, count).astype(np.int64)
        return Samples(
            self.values[keep], self.reference[keep], self.weights[keep], self.positions[keep]
        )


def samples_of(prior: PriorImage, reference_m: Image) -> Samples:
    """The pixels [H, W] of a frame with a prior and a positive reference depth."""
    both = prior.known & (reference_m > 0)
    row, column = np.nonzero(both)
    depth = reference_m[both].astype(np.float64)
    weights = np.ones(len(depth)) if prior.weights is None else prior.weights[both]
    height, width = both.shape
    return Samples(
        prior.values[both].astype(np.float64),
        1.0 / depth if prior.kind.inverse else depth,
        weights.astype(np.float64),
        np.stack([(column + 0.5) / width, (row + 0.5) / height], 1),
    )


@dataclass(frozen=True)
class ScaleShift:
    """Correction of a prior: x = scale * value + shift, with x = z or 1 / z.

    Attributes:
        scale: > 0. shift: in the unit of x.
        noise: standard deviation of the prior relative to its value.
        inliers: fraction of the samples that agree.
    """

    scale: float
    shift: float = 0.0
    noise: float = 0.0
    inliers: float = 1.0

    def apply(self, prior: PriorImage) -> Image:
        """Corrected depth [H, W] in the unit of the reference, 0 where there is none."""
        return _depth(self.scale * prior.values + self.shift, prior)


@dataclass(frozen=True)
class ScaleShiftGrid:
    """Corrections at the nodes of a grid, interpolated between them.

    Attributes:
        whole: correction of the whole image, which the nodes are close to.
        slope: [G, G] a at the nodes. offset: [G, G] b at the nodes.
    """

    whole: ScaleShift
    slope: Array
    offset: Array

    @property
    def bend(self) -> float:
        """RMS deviation of the scales at the nodes from that of the whole image, relative to it."""
        return float(np.sqrt(np.mean((self.slope * self.whole.scale - 1.0) ** 2)))

    def apply(self, prior: PriorImage) -> Image:
        """Corrected depth [H, W] in the unit of the reference, 0 where there is none."""
        height, width = prior.values.shape
        count = len(self.slope)
        columns, rows = (
            np.clip((np.arange(size, dtype=np.float32) + 0.5) / size * (count - 1), 0, count - 1)
            for size in (width, height)
        )
        at = np.meshgrid(columns, rows)
        slope, offset = (
            cv2.remap(nodes.astype(np.float32), *at, cv2.INTER_LINEAR)
            for nodes in (self.slope, self.offset)
        )
        return _depth((prior.values - offset) / slope, prior)


Correction = ScaleShift | ScaleShiftGrid


def _depth(corrected: NDArray, prior: PriorImage) -> Image:
    known = prior.known & (corrected > 0)
    safe = np.where(known, corrected, 1.0)
    return np.where(known, 1.0 / safe if prior.kind.inverse else safe, 0.0).astype(np.float32)


def least_squares(samples: Samples, with_shift: bool = True) -> ScaleShift | None:
    """The correction of H-16 as printed: least squares in the reference, over all samples.

    Returns:
        None without enough samples, or if the scale is not positive.
    """
    if len(samples) < _MIN_SAMPLES:
        return None
    columns = [samples.values, np.ones(len(samples))][: 1 + with_shift]
    (scale, *shift), *_ = np.linalg.lstsq(np.stack(columns, 1), samples.reference, rcond=None)
    if not scale > 0:
        return None
    found = ScaleShift(float(scale), float(shift[0]) if shift else 0.0)
    error = found.scale * samples.values + found.shift - samples.reference
    noise = np.sqrt(np.mean((error / np.maximum(samples.reference, 1e-9)) ** 2))
    return ScaleShift(found.scale, found.shift, float(noise))


def robust_fit(samples: Samples, with_shift: bool = True) -> ScaleShift | None:
    """The correction that most samples agree with.

    Inliers have Gaussian noise in proportion to their value, outliers any value (a mixture that is
    fitted by expectation maximisation). Almost half of the samples may be outliers.

    Returns:
        None without enough samples, or if the scale is not positive.
    """
    samples = samples.thinned()
    if len(samples) < _MIN_SAMPLES:
        return None
    x, v = samples.reference, samples.values
    spread = float(np.std(x)) / max(float(np.mean(x)), 1e-12)
    with_shift = with_shift and spread > _MIN_SPREAD
    a, b = _first_guess(x, v, with_shift)
    if not a > 0:
        return None
    design = np.stack([x, np.ones_like(x)], 1)[:, : 1 + with_shift]
    parameters = np.array([a, b])[: 1 + with_shift]
    fit = _mixture(design, samples, parameters, None)
    fit = replace(fit, parameters=_peak(design, samples, fit))
    a, b = float(fit.parameters[0]), float(fit.parameters[1]) if with_shift else 0.0
    if not a > 0:
        return None
    return ScaleShift(1.0 / a, -b / a, fit.noise, fit.inliers)


def fit_grid(samples: Samples, whole: ScaleShift, nodes: int, with_shift: bool) -> ScaleShiftGrid:
    """Corrections on a smooth grid, near that of the whole image.

    Args:
        nodes: number of nodes per axis, at least 2.
        with_shift: whether shifts differ between nodes; otherwise only scales do.
    """
    samples = samples.thinned()
    a, b = 1.0 / whole.scale, -whole.shift / whole.scale
    count = nodes * nodes
    if len(samples) < _MIN_SAMPLES:
        return ScaleShiftGrid(whole, np.full((nodes, nodes), a), np.full((nodes, nodes), b))
    share = _shares(samples.positions, nodes)
    typical = a * float(np.median(samples.reference))
    design, start = share * samples.reference[:, None], np.full(count, a)
    sigma = [a * _STEP_SCALE]
    if with_shift:
        design, start = np.concatenate([design, share], 1), np.append(start, np.full(count, b))
        sigma.append(typical * _STEP_SHIFT)
    else:
        samples = replace(samples, values=samples.values - b)
    found = _mixture(design, samples, start, _smoothness(nodes, sigma), whole.noise).parameters
    slope = found[:count].reshape(nodes, nodes).clip(a / _MAX_LOCAL, a * _MAX_LOCAL)
    offset = found[count:] if with_shift else np.full(count, b)
    return ScaleShiftGrid(whole, slope, offset.reshape(nodes, nodes))


def fit(samples: Samples, kind: DepthKind, robust: bool) -> ScaleShift | None:
    """Correction of one image or a set. Plain least squares (H-16) always have a shift."""
    return robust_fit(samples, kind.has_shift) if robust else least_squares(samples)


@dataclass(frozen=True)
class _Fit:
    parameters: Array
    noise: float
    inliers: float


def _first_guess(x: Array, v: Array, with_shift: bool) -> tuple[float, float]:
    """Slope and offset of a line through the medians of groups of equal x."""
    if not with_shift:
        return float(np.median(v / x)), 0.0
    order = np.argsort(x, kind="stable")
    groups = np.array_split(order, _GROUPS)
    middle = np.array([np.median(x[g]) for g in groups])
    level = np.array([np.median(v[g]) for g in groups])
    i, j = np.triu_indices(_GROUPS, 1)
    run = middle[j] - middle[i]
    wide = run > 0.2 * (middle[-1] - middle[0])
    slope = float(np.median((level[j] - level[i])[wide] / run[wide]))
    return slope, float(np.median(level - slope * middle))


def _mixture(
    design: Array,
    samples: Samples,
    parameters: Array,
    prior: Array | None,
    noise: float | None = None,
) -> _Fit:
    """Fit `values = design @ parameters` to the inliers among the samples.

    Args:
        design: [N, P].
        parameters: [P] to start from.
        prior: [P, P] information of the differences from the start; without one, pixels count as
            independent.
        noise: to start from; by default the median residual.
    """
    values, weights, start = samples.values, samples.weights, parameters
    floor = _MIN_RELATIVE * float(np.median(np.abs(values)))
    inliers = 0.6
    for _ in range(_ROUNDS):
        expected = design @ parameters
        unit = np.maximum(np.abs(expected), floor)
        residual = (values - expected) / unit
        if noise is None:
            noise = 1.4826 * float(np.median(np.abs(residual)))
        noise = max(noise, _MIN_SIGMA)
        low, high = np.percentile(residual, [0.5, 99.5])
        outlier = (1.0 - inliers) / max(high - low, 6.0 * noise)
        core = inliers * np.exp(-0.5 * (residual / noise) ** 2) / (noise * np.sqrt(2.0 * np.pi))
        member = weights * core / (core + outlier)
        total = float(member.sum())
        if total < _MIN_SAMPLES / 3:
            break
        information = member / (unit * noise) ** 2
        if prior is not None:
            information /= _CORRELATED_PIXELS
        normal = design.T @ (design * information[:, None])
        right = design.T @ (information * (values - design @ start))
        if prior is not None:
            normal = normal + prior
        unit_of = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        scaled = normal * unit_of[:, None] * unit_of
        change = unit_of * np.linalg.lstsq(scaled, unit_of * right, rcond=None)[0]
        previous, parameters = parameters, start + change
        residual = (values - design @ parameters) / unit
        noise = float(np.sqrt((member * residual**2).sum() / total))
        inliers = float(np.clip(total / weights.sum(), 0.05, 0.999))
        if np.abs(parameters - previous).max() < _SAME * np.abs(parameters).max():
            break
    return _Fit(parameters, float(noise or 0.0), inliers)


def _peak(design: Array, samples: Samples, fit: _Fit) -> Array:
    """Parameters [P] of the middle of the densest part of the residuals (modal regression).

    Errors of the reference are taken into account by instrumental variables: the expected true
    reference given both observations replaces the observed one in the moment conditions.
    """
    values, parameters = samples.values, fit.parameters
    floor = _MIN_RELATIVE * float(np.median(np.abs(values)))
    noise = max(fit.noise, _MIN_SIGMA)
    # Share of the reference in the variance of the residuals.
    share = min((REFERENCE_NOISE / noise) ** 2, _MAX_REFERENCE_SHARE)
    for _ in range(_ROUNDS):
        expected = design @ parameters
        unit = np.maximum(np.abs(expected), floor)
        residual = values - expected
        weight = samples.weights * np.exp(-0.5 * (residual / (unit * _PEAK * noise)) ** 2)
        instruments = design.copy()
        instruments[:, 0] += share * residual / parameters[0]
        weighted = instruments * (weight / unit**2)[:, None]
        previous = parameters
        parameters = np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=None)[0]
        if np.abs(parameters - previous).max() < _SAME * np.abs(parameters).max():
            break
    return np.asarray(parameters)


def _shares(positions: Array, nodes: int) -> Array:
    """Bilinear weights [N, nodes * nodes] of the nodes at positions [N, 2] in [0, 1]."""
    at = np.clip(positions * (nodes - 1), 0.0, nodes - 1.0)
    axes = [np.maximum(0.0, 1.0 - np.abs(at[:, i : i + 1] - np.arange(nodes))) for i in (0, 1)]
    return np.asarray((axes[1][:, :, None] * axes[0][:, None, :]).reshape(len(at), -1))


def _smoothness(nodes: int, sigma: Sequence[float]) -> Array:
    """Information [K G^2, K G^2] that ties neighbouring nodes, and all weakly to the start."""
    count = nodes * nodes
    number = np.arange(count).reshape(nodes, nodes)
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    first = np.concatenate([a.reshape(-1) for a, _ in pairs])
    second = np.concatenate([b.reshape(-1) for _, b in pairs])
    difference = np.zeros((len(first), count))
    difference[np.arange(len(first)), first] = 1.0
    difference[np.arange(len(first)), second] = -1.0
    one = difference.T @ difference + np.eye(count) * _FROM_GLOBAL**2
    information = np.zeros((len(sigma) * count, len(sigma) * count))
    for index, step in enumerate(sigma):
        block = slice(index * count, (index + 1) * count)
        information[block, block] = one / step**2
    return information
