"""Whether depth priors are what they are declared as, and agree with the motion of the camera.

Triangulated points give the depth of some pixels of each keyframe. If a declared kind is right, a
scale, and where the kind has one a shift, relate the priors to these depths. If another kind
relates them much better, or none does, the declaration or the priors are wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.depth_priors.provider import DepthKind, DepthPrior

Array = NDArray[np.float64]

# Keyframes that are judged, how many are needed for a verdict, and how many points of each.
MAX_KEYFRAMES, _MIN_KEYFRAMES, _MIN_POINTS = 10, 4, 20
# Keyframes whose depths differ by a smaller factor (90th to 10th percentile) say nothing.
_MIN_RANGE = 1.15
# Correlations of values and the logarithm of depth. Right priors reach 0.6 to 1, with 30 % of noise
# in each pixel 0.2 to 0.6; priors of other images -0.7 to 0.9 with medians up to 0.5.
_OPPOSITE, _NONE, _NEGATIVE = -0.3, 0.15, -0.05
_MOST, _SOME, _HALF = 0.8, 0.2, 0.5
# By how much a correlation must be higher for other priors to belong to a keyframe.
_HIGHER = 0.2
# Percentiles beyond which values and depths count as less extreme ones.
_EXTREME = (5.0, 95.0)
# Another kind of the same direction is named if its errors are small, and these parts of those of
# the declared kind, which are not.
_SMALL, _LARGE, _MUCH_SMALLER = 0.06, 0.08, 0.4
# Relative errors of depth count as at most this much: some points are triangulated wrongly.
_LARGEST = 0.3
# Without a shift, errors may be this much larger than with one.
_AS_GOOD, _SAME = 1.2, 0.005
_ROUNDS = 12


def _same(depths: Array) -> Array:
    return depths


@dataclass(frozen=True)
class _Relation:
    """How values depend on depth.

    Attributes:
        name: for messages.
        forward: from depth [N] to what values are proportional to. inverse: back again.
        inverted: whether near pixels have high values.
        shift: whether an unknown shift is added.
        kind: declared for this relation; None if it must be converted.
    """

    name: str
    forward: Callable[[Array], Array]
    inverse: Callable[[Array], Array]
    inverted: bool
    shift: bool
    kind: DepthKind | None

    def error(self, values: Array, depths: Array) -> float:
        """Mean relative error of the depths that follow from values, with the best parameters.

        An error counts as at most `_LARGEST`.
        """
        scale, shift = _robust_line(self.forward(depths), values, self.shift)
        if not scale > 0.0:
            return _LARGEST
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            found = self.inverse((values - shift) / scale)
            errors = np.abs(found / depths - 1.0)
        return float(np.where((found > 0) & (errors < _LARGEST), errors, _LARGEST).mean())


_RELATIONS = (
    _Relation("depth up to scale", _same, _same, False, False, DepthKind.SCALED),
    _Relation("depth up to scale and shift", _same, _same, False, True, DepthKind.AFFINE),
    _Relation("the logarithm of depth", np.log, np.exp, False, True, None),
    _Relation("inverse depth", np.reciprocal, np.reciprocal, True, True, DepthKind.AFFINE_INVERSE),
)


@dataclass(frozen=True, eq=False)
class KnownDepths:
    """Pixels of a keyframe whose depth is known: [N, 2] columns and rows, and depths [N] > 0."""

    pixels: Array
    depths: Array


def prior_doubt(
    priors: Sequence[DepthPrior], known: Sequence[KnownDepths], option: str | None
) -> str | None:
    """A line about priors that are not what is declared; None if they agree or say too little.

    Args:
        priors: of keyframes, all of one kind.
        known: pixels of the same keyframes with their depths, up to one scale.
        option: that declares the kind; None if the model determines it.
    """
    samples = [_samples(*pair) for pair in zip(priors, known, strict=True)]
    judged = [n for n, own in enumerate(samples) if _is_enough(own[1])]
    if len(judged) < _MIN_KEYFRAMES:
        return None
    kind = priors[0].kind
    own = np.array([_agreement(kind, *samples[n]) for n in judged])
    errors = [[relation.error(*samples[n]) for relation in _RELATIONS] for n in judged]
    typical = np.median(errors, axis=0)
    if np.median(own) < _OPPOSITE and (own < 0.0).mean() >= _MOST:
        found = _best(typical, not kind.inverse)
        return _declared_wrongly(kind, found, option)
    foreign = _foreign(kind, [priors[n] for n in judged], [known[n] for n in judged], own)
    if foreign or np.median(own) < _NONE or (own < _NEGATIVE).mean() >= _SOME:
        return (
            f"the depth priors contradict the motion of the camera (correlation with the "
            f"depths of its points {np.median(own):.2f}){foreign}; check that the maps belong to "
            f"these images"
        )
    stated = [r.kind for r in _RELATIONS].index(
        DepthKind.SCALED if kind is DepthKind.METRIC else kind
    )
    found = _best(typical, kind.inverse)
    better = typical[_RELATIONS.index(found)]
    if better < min(_SMALL, _MUCH_SMALLER * typical[stated]) and typical[stated] > _LARGE:
        return _declared_wrongly(kind, found, option)
    return None


def _declared_wrongly(kind: DepthKind, found: _Relation, option: str | None) -> str:
    line = (
        f"the depth priors are declared as {kind.value}, but the motion of the camera shows that "
        f"they are {found.name}"
    )
    if option is None:
        return line
    remedy = "write maps of depth" if found.kind is None else f"use {option} {found.kind.value}"
    return f"{line}; {remedy}"


def _best(typical: Array, inverse: bool) -> _Relation:
    """The relation of one direction with the smallest errors [R]; the simplest of equal ones."""
    numbers = [n for n, r in enumerate(_RELATIONS) if r.inverted == inverse]
    smallest = min(typical[n] for n in numbers)
    return _RELATIONS[next(n for n in numbers if typical[n] <= _AS_GOOD * smallest + _SAME)]


def _foreign(
    kind: DepthKind, priors: Sequence[DepthPrior], known: Sequence[KnownDepths], own: Array
) -> str:
    """What the priors are instead of those of their images, for a message; empty if they are."""
    others = np.array([[_agreement(kind, *_samples(p, k)) for p in priors] for k in known])
    found = {", those of other images agree better": (others.max(axis=1), _HALF)}
    for name, axes in (("mirrored", np.s_[:, ::-1]), ("upside down", np.s_[::-1])):
        changed = [_with_values(prior, prior.values[axes]) for prior in priors]
        agreement = [_agreement(kind, *_samples(p, k)) for p, k in zip(changed, known, strict=True)]
        found[f", they are {name}"] = np.array(agreement), _MOST
    text, (best, share) = max(found.items(), key=lambda item: float(np.median(item[1][0])))
    return text if (best > own + _HIGHER).mean() >= share else ""


def _with_values(prior: DepthPrior, values: NDArray[np.float32]) -> DepthPrior:
    return replace(prior, values=np.ascontiguousarray(values), mask=None, confidence=None)


def _is_enough(depths: Array) -> bool:
    if len(depths) < _MIN_POINTS:
        return False
    near, far = np.percentile(depths, [10.0, 90.0])
    return bool(far > _MIN_RANGE * near)


def _agreement(kind: DepthKind, values: Array, depths: Array) -> float:
    """Correlation of values and depths, in the direction of the kind; 0 if it is undefined.

    The highest and lowest values and depths count as less extreme ones (winsorised).
    """
    if len(values) < _MIN_POINTS:
        return 0.0
    pair = [np.clip(each, *np.percentile(each, _EXTREME)) for each in (values, np.log(depths))]
    if min(np.ptp(each) for each in pair) == 0.0:
        return 0.0
    correlation = float(np.corrcoef(*pair)[0, 1])
    return -correlation if kind.inverse else correlation


def _samples(prior: DepthPrior, known: KnownDepths) -> tuple[Array, Array]:
    """Values [N] of a prior and depths [N] at the pixels where both are known."""
    scale, offset = np.array(prior.pixels.scale), np.array(prior.pixels.offset)
    at = np.rint(scale * (known.pixels + 0.5) + offset - 0.5).astype(np.intp)
    height, width = prior.values.shape
    inside = ((at >= 0) & (at < (width, height))).all(axis=1)
    column, row = np.where(inside[:, None], at, 0).T
    used = inside & prior.valid[row, column]
    return prior.values[row, column][used].astype(np.float64), known.depths[used]


def _robust_line(x: Array, values: Array, with_shift: bool) -> tuple[float, float]:
    """Scale and shift with the smallest absolute errors of values [N]."""
    if not with_shift:
        return float(np.median(values / x)), 0.0
    design = np.column_stack([x, np.ones_like(x)])
    weights = np.ones_like(x)
    solution = np.zeros(2)
    for _ in range(_ROUNDS):
        weighted = design * weights[:, None]
        solution = np.array(
            np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=None)[0]
        )
        residuals = np.abs(values - design @ solution)
        weights = 1.0 / np.maximum(residuals, 1e-3 * np.median(residuals) + 1e-12)
    return float(solution[0]), float(solution[1])
