"""Scale and shift of a keyframe's corrected depth prior, optimised with the Gaussians (H-17)."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from toolkit.keyframe import Keyframe
from toolkit.losses.depth_gradient import by_observed_depth

# Learning rate of the scale, and of the shift relative to the median depth.
_RATE = 1e-3
# Decay of Adam's moments, and its epsilon for gradients relative to the depth loss.
_DECAY, _DECAY_SQUARED, _EPSILON = 0.9, 0.99, 1e-8


def adjust_depth(
    keyframe: Keyframe, gradient: Tensor, images: Tensor, regularisation: float
) -> None:
    """Take one step on the scale and the shift of a keyframe's depth.

    The state of a keyframe is log scale, shift relative to the median depth, two first and two
    second moments of their gradients, and the number of steps. The logarithm keeps the scale
    positive.

    Args:
        keyframe: its `prior_m` is the depth after the initial correction.
        gradient: [C, H, W] of the mapping loss by the rendered images, as a sum over pixels.
        images: [C, H, W] the rendered images.
        regularisation: weight of the deviation from the initial values.
    """
    prior_m = keyframe.prior_m
    assert prior_m is not None
    known = prior_m > 0
    if not bool(known.any()):
        return
    state = np.zeros(7) if keyframe.depth_moments is None else keyframe.depth_moments
    median_m = float(prior_m[known].median())
    by_depth = by_observed_depth(gradient, images).to(prior_m)
    log_scale, shift = state[0], state[1]
    scale = math.exp(log_scale)
    # Pixels without a compared depth have no gradient.
    count = max(int((by_depth != 0).sum()), 1)
    descent = np.array(
        [float((by_depth * prior_m).sum()) * scale, float(by_depth.sum()) * median_m]
    )
    deviation = np.array([np.sign(scale - 1.0) * scale, np.sign(shift) * median_m])
    descent = descent / count + regularisation * deviation
    steps = state[6] + 1
    first = _DECAY * state[2:4] + (1.0 - _DECAY) * descent
    second = _DECAY_SQUARED * state[4:6] + (1.0 - _DECAY_SQUARED) * descent**2
    unbiased = first / (1.0 - _DECAY**steps)
    change = unbiased / (np.sqrt(second / (1.0 - _DECAY_SQUARED**steps)) + _EPSILON)
    log_scale, shift = state[:2] - _RATE * change
    keyframe.depth_moments = np.array([log_scale, shift, *first, *second, steps])
    adjusted = math.exp(log_scale) * prior_m + shift * median_m
    keyframe.depth_m = adjusted.clamp(min=0.0) * known
