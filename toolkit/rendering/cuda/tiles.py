"""Device functions shared by compositing and differentiation: pixels and alphas of a tile."""

import triton
import triton.language as tl

from toolkit.native import constants
from toolkit.rendering.cuda.projection import SPLAT

MIN_ALPHA = tl.constexpr(constants.MIN_ALPHA)
MAX_ALPHA = tl.constexpr(constants.MAX_ALPHA)
BASE = tl.constexpr(constants.BASE_CHANNELS)


@triton.jit
def pixels_of(tile, width, height, SIDE: tl.constexpr):
    """Return columns and rows of a tile's pixels, and a mask of those inside the image."""
    tiles_x = tl.cdiv(width, SIDE)
    pixel = tl.arange(0, SIDE * SIDE)
    x = tile % tiles_x * SIDE + pixel % SIDE
    y = tile // tiles_x * SIDE + pixel // SIDE
    return x, y, (x < width) & (y < height)


@triton.jit
def alphas_of(splats, gaussian, valid, x, y):
    """Return alphas [batch, pixels] before thresholding and clamping, 0 for invalid pairs."""
    at = splats + gaussian * SPLAT
    u = tl.load(at, mask=valid, other=0.0)
    v = tl.load(at + 1, mask=valid, other=0.0)
    exponent = tl.load(at + 2, mask=valid, other=0.0)
    opacity = tl.load(at + 3, mask=valid, other=0.0)
    dx = x.to(tl.float32)[None, :] - u[:, None]
    dy = y.to(tl.float32)[None, :] - v[:, None]
    return opacity[:, None] * tl.exp(exponent[:, None] * (dx * dx + dy * dy))


@triton.jit
def cut(raw):
    """Return alphas after thresholding and clamping, and 1 - alpha, which is never 0."""
    alpha = tl.where(raw >= MIN_ALPHA, tl.minimum(raw, MAX_ALPHA), 0.0)
    return alpha, 1.0 - alpha


@triton.jit
def colour_and_depth(splats, gaussian, valid):
    """Load red, green, blue and depth [batch] of Gaussians."""
    at = splats + gaussian * SPLAT + 4
    red = tl.load(at, mask=valid, other=0.0)
    green = tl.load(at + 1, mask=valid, other=0.0)
    blue = tl.load(at + 2, mask=valid, other=0.0)
    return red, green, blue, tl.load(at + 3, mask=valid, other=0.0)


@triton.jit
def checkpoints_of(checkpoints, begin, tile, BATCH: tl.constexpr, PIXELS: tl.constexpr):
    """Return pointers [pixels] to the checkpoints of a tile; those of tiles never overlap."""
    first = (begin // BATCH + tile).to(tl.int64)
    return checkpoints + first * PIXELS + tl.arange(0, PIXELS)
