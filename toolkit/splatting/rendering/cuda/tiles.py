"""Device functions shared by compositing and differentiation: pixels and alphas of a tile."""

import triton
import triton.language as tl

from toolkit.base.native import constants
from toolkit.splatting.rendering.cuda.projection import SHAPED_SPLAT, SPLAT

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
def splats_at(splats, gaussian, SHAPED: tl.constexpr):
    """Return pointers [batch] to the splats of Gaussians."""
    return splats + gaussian * (SHAPED_SPLAT if SHAPED else SPLAT)


@triton.jit
def alphas_of(splat, valid, x, y, SHAPED: tl.constexpr):
    """Return alphas [batch, pixels] before thresholding and clamping, 0 for invalid pairs.

    Also return the coordinates [batch, pixels] of the pixels, relative to the centre; if SHAPED,
    they are s and t of `ellipsoids`, in which the Gaussian is round.
    """
    u = tl.load(splat, mask=valid, other=0.0)
    v = tl.load(splat + 1, mask=valid, other=0.0)
    scale = tl.load(splat + 2, mask=valid, other=0.0)
    opacity = tl.load(splat + 3, mask=valid, other=0.0)
    dx = x.to(tl.float32)[None, :] - u[:, None]
    dy = y.to(tl.float32)[None, :] - v[:, None]
    if SHAPED:
        skew = tl.load(splat + 8, mask=valid, other=0.0)
        height = tl.load(splat + 9, mask=valid, other=0.0)
        s, t = scale[:, None] * dx + skew[:, None] * dy, height[:, None] * dy
        return opacity[:, None] * tl.exp(-(s * s + t * t)), s, t
    return opacity[:, None] * tl.exp(scale[:, None] * (dx * dx + dy * dy)), dx, dy


@triton.jit
def cut(raw):
    """Return alphas after thresholding and clamping, and 1 - alpha, which is never 0."""
    alpha = tl.where(raw >= MIN_ALPHA, tl.minimum(raw, MAX_ALPHA), 0.0)
    return alpha, 1.0 - alpha


@triton.jit
def colour_and_depth(splat, valid):
    """Load red, green, blue and depth [batch] of Gaussians."""
    red = tl.load(splat + 4, mask=valid, other=0.0)
    green = tl.load(splat + 5, mask=valid, other=0.0)
    blue = tl.load(splat + 6, mask=valid, other=0.0)
    return red, green, blue, tl.load(splat + 7, mask=valid, other=0.0)


@triton.jit
def depths_of(splat, valid, z, s, t, SHAPED: tl.constexpr):
    """Return depths [batch, pixels], or [batch, 1] of spheres, which have one depth."""
    depth = z[:, None]
    if SHAPED:
        along_s = tl.load(splat + 10, mask=valid, other=0.0)
        along_t = tl.load(splat + 11, mask=valid, other=0.0)
        depth += along_s[:, None] * s + along_t[:, None] * t
    return depth


@triton.jit
def checkpoints_of(checkpoints, begin, tile, BATCH: tl.constexpr, PIXELS: tl.constexpr):
    """Return pointers [pixels] to the checkpoints of a tile; those of tiles never overlap."""
    first = (begin // BATCH + tile).to(tl.int64)
    return checkpoints + first * PIXELS + tl.arange(0, PIXELS)
