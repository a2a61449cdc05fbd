"""Imperfections of real recordings that are no noise: white balance, flying pixels, reflections."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.reflections import RETURNED_COSINES
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

# White balance: distance in frames between steps, duration of a step, and largest logarithmic
# gain of red, opposite to that of blue.
_STEP_FRAMES, _STEP_DURATION, _WARMTH = (40, 80), 12.0, 0.12
# Logarithmic amplitudes and periods in frames of the exposure of all channels.
_EXPOSURE = ((0.06, 110.0), (0.03, 47.0))

# Flying pixels lie within two pixels of an edge; this fraction of the pixels there is wrong.
_FLYING_SHARE = 0.4
_NEIGHBOURHOOD = np.ones((5, 5), np.uint8)

# Surfaces that reflect: they return depth only at middle angles, which vary by pixel.
SHINY = ("bottle", "bowl", "cup", "monitor", "table", "tv-screen", "vase", "window")
_COSINE_SPREAD = 0.05


def white_balance_gains(frames: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Gains [frames, 3] of the channels, smooth in time; those of the first frame are 1."""
    time = np.arange(frames)
    phases = rng.uniform(0.0, 2 * math.pi, len(_EXPOSURE))
    exposure = sum(
        amplitude * np.sin(2 * math.pi * time / period + phase)
        for (amplitude, period), phase in zip(_EXPOSURE, phases, strict=True)
    )
    warmth, now, last = np.zeros(frames), 0.0, 0.0
    while (now := now + rng.uniform(*_STEP_FRAMES)) < frames + _STEP_DURATION:
        target = rng.uniform(-_WARMTH, _WARMTH)
        before = np.minimum(-4.0 * (time - now) / _STEP_DURATION, 700.0)  # exp is finite
        warmth += (target - last) / (1.0 + np.exp(before))
        last = target
    log_gains = np.stack([exposure + warmth, exposure, exposure - warmth], axis=1)
    return np.asarray(np.exp(log_gains - log_gains[0]))


def with_flying_pixels(
    depth_m: NDArray, true_m: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[np.floating]:
    """Mix the depths of both surfaces in a part of the pixels beside depth edges.

    Args:
        depth_m: [H, W] measured depth, 0 where missing; stays missing there.
        true_m: [H, W] true depth, 0 where no surface is hit.
    """
    known = np.where(true_m > 0, true_m, np.float32(np.inf))
    nearest, farthest = cv2.erode(known, _NEIGHBOURHOOD), cv2.dilate(true_m, _NEIGHBOURHOOD)
    chance, share = rng.random((2, *depth_m.shape), dtype=np.float32)
    edge = farthest - nearest > 0.05 + 0.03 * nearest
    flying = edge & (depth_m > 0) & (chance < _FLYING_SHARE)
    return np.where(flying, nearest + (0.1 + 0.8 * share) * (farthest - nearest), depth_m)


def without_reflections(
    depth_m: NDArray,
    labels: NDArray[np.int32],
    cosine: NDArray[np.float32],
    rng: np.random.Generator,
) -> NDArray[np.floating]:
    """Remove depth [H, W] on shiny objects, except where they are seen at a middle angle."""
    shiny = np.isin(labels, [CLASS_IDS[name] for name in SHINY])
    seen = cosine + _COSINE_SPREAD * rng.standard_normal(depth_m.shape, dtype=np.float32)
    low, high = RETURNED_COSINES
    returned = (seen > low) & (seen < high)
    return np.where(shiny & ~returned, 0.0, depth_m)
