"""Depth as sensors of several kinds measure it: noise, smoothing, holes, range, sparse samples."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]


def measured(rng: Generator, depth_m: Depth, cosine: NDArray[np.float32], dark: Mask) -> Depth:
    """Depth [H, W] as a random sensor measures it, 0 where it measures nothing.

    Args:
        depth_m: [H, W] true depth, 0 where no surface is hit.
        cosine: [H, W] of the angle between ray and normal.
        dark: [H, W] surfaces of glass, screens and steel.
    """
    kind = rng.choice(["ideal", "structured", "time of flight", "stereo", "lidar"])
    depth = depth_m.copy()
    if kind == "structured":
        depth = _structured(rng, depth)
    elif kind == "time of flight":
        depth += rng.uniform(0.0, 0.012) * rng.standard_normal(depth.shape, dtype=np.float32)
        depth *= 1.0 + 0.02 * _smooth(rng, depth.shape, 8)
    elif kind == "stereo":
        depth = _stereo(rng, depth)
    elif kind == "lidar":
        depth = _upsampled(rng, depth)
    depth[depth_m == 0] = 0.0
    if kind != "ideal":
        depth[_missing(rng, depth_m, cosine, dark)] = 0.0
    return np.maximum(depth, 0.0).astype(np.float32)


def _structured(rng: Generator, depth: Depth) -> Depth:
    """Noise of disparity, which is smooth over some pixels, and its quantisation."""
    baseline = rng.uniform(25.0, 60.0)  # pixels times metres
    disparity = baseline / np.maximum(depth, 0.05)
    noise = rng.standard_normal(depth.shape, dtype=np.float32)
    disparity += rng.uniform(0.02, 0.3) * cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.4, 1.2))
    step = rng.choice([0.0, 0.125])
    if step:
        disparity = np.round(disparity / step) * step
    return np.asarray(baseline / np.maximum(disparity, 1e-3), dtype=np.float32)


def _stereo(rng: Generator, depth: Depth) -> Depth:
    """Errors that are correlated over patches, and edges that are fattened."""
    kernel = np.ones((3, 3), np.uint8)
    if rng.random() < 0.5:
        filled = np.where(depth > 0, depth, np.float32(1e3))
        depth = np.where(depth > 0, cv2.erode(filled, kernel), 0).astype(np.float32)
    error = _smooth(rng, depth.shape, int(rng.integers(6, 24)))
    return np.asarray(depth + rng.uniform(0.0, 0.012) * depth**2 * error, dtype=np.float32)


def _upsampled(rng: Generator, depth: Depth) -> Depth:
    """Coarse depth, interpolated: the LiDAR of phones, and depth that was filled in."""
    height, width = depth.shape
    factor = rng.uniform(1.5, 4.0)
    filled = np.where(depth > 0, depth, np.median(depth)).astype(np.float32)
    coarse = cv2.resize(
        filled, (int(width / factor), int(height / factor)), interpolation=cv2.INTER_AREA
    )
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, dtype=np.float32)


def _missing(rng: Generator, true: Depth, cosine: NDArray[np.float32], dark: Mask) -> Mask:
    """Holes: at grazing angles, edges, dark surfaces, out of range, in blobs; sparse depth."""
    random = rng.random(true.shape, dtype=np.float32)
    gone = cosine < rng.uniform(0.0, 0.25) * random
    gone |= true > rng.choice([3.5, 5.0, 8.0, 20.0])
    gone |= true < rng.uniform(0.1, 0.4)
    gone |= dark & (random < rng.choice([0.0, 0.3, 1.0]))
    kernel = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(true, kernel) - cv2.erode(true, kernel) > 0.05 + 0.05 * true
    gone |= edge & (random < rng.uniform(0.0, 1.0))
    if rng.random() < 0.4:
        gone |= _smooth(rng, true.shape, int(rng.integers(3, 12))) > rng.uniform(1.0, 2.2)
    if rng.random() < 0.08:
        gone |= random > rng.uniform(0.3, 0.9)
    return gone


def _smooth(rng: Generator, shape: tuple[int, ...], cells: int) -> NDArray[np.float32]:
    """A smooth random image of about unit variance with `cells` knots across."""
    knots = rng.standard_normal((max(2, cells * 3 // 4), cells), dtype=np.float32)
    size = shape[1], shape[0]
    return np.asarray(cv2.resize(knots, size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)
