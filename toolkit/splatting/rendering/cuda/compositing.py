"""Kernel: front-to-back compositing of one tile per program (H-19, G-1).

The weights of a batch of Gaussians at the pixels of a tile form a matrix. Sums over Gaussians are
matrix products on tensor cores; the transmittance is a product scan along the batch.
"""

import triton
import triton.language as tl

from toolkit.base.native import constants
from toolkit.splatting.rendering.cuda.tiles import (
    BASE,
    alphas_of,
    checkpoints_of,
    colour_and_depth,
    cut,
    depths_of,
    pixels_of,
    splats_at,
)

MIN_TRANSMITTANCE = tl.constexpr(constants.MIN_TRANSMITTANCE)


@triton.jit
def _blend(weight, value):
    """Sum over the batch of weights [batch, pixels] times a value [batch]."""
    return tl.sum(weight * value[:, None], axis=0)


@triton.jit
def composite(
    splats,
    features,
    means,
    pair_gaussians,
    tile_begins,
    images,
    centre_images,
    checkpoints,
    transmittance,
    batches,
    width,
    height,
    channels,
    SIDE: tl.constexpr,
    BATCH: tl.constexpr,
    BLOCK_C: tl.constexpr,
    CENTRES: tl.constexpr,
    SHAPED: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Composite images [5 + S, H, W] and centres [3, H, W]; a program handles one channel block.

    For the backward pass it also writes the final transmittance [tiles, pixels], the transmittance
    before every batch [checkpoints, pixels], and the number of batches [tiles] until the tile was
    opaque. BLOCK_C is 0 without features.
    """
    PIXELS: tl.constexpr = SIDE * SIDE
    tile, block = tl.program_id(0), tl.program_id(1)
    x, y, inside = pixels_of(tile, width, height, SIDE)
    begin, end = tl.load(tile_begins + tile), tl.load(tile_begins + tile + 1)
    checkpoint = checkpoints_of(checkpoints, begin, tile, BATCH, PIXELS)
    left = inside.to(tl.float32)
    red = tl.zeros([PIXELS], dtype=tl.float32)
    green, blue, depth = red, red, red
    centre_x, centre_y, centre_z = red, red, red
    if BLOCK_C > 0:
        c = block * BLOCK_C + tl.arange(0, BLOCK_C)
        sums = tl.zeros([BLOCK_C, PIXELS], dtype=tl.float32)
    done = 0
    while (begin + done * BATCH < end) & (tl.max(left, axis=0) >= MIN_TRANSMITTANCE):
        pair = begin + done * BATCH + tl.arange(0, BATCH)
        valid = pair < end
        gaussian = tl.load(pair_gaussians + pair, mask=valid, other=0).to(tl.int64)
        splat = splats_at(splats, gaussian, SHAPED)
        raw, s, t = alphas_of(splat, valid, x, y, SHAPED)
        alpha, keep = cut(raw)
        passed = tl.cumprod(keep, axis=0)
        weight = alpha * (left[None, :] * passed / keep)
        if block == 0:
            tl.store(checkpoint + done * PIXELS, left)
            r, g, b, z = colour_and_depth(splat, valid)
            red += _blend(weight, r)
            green += _blend(weight, g)
            blue += _blend(weight, b)
            depth += tl.sum(weight * depths_of(splat, valid, z, s, t, SHAPED), axis=0)
            if CENTRES:
                at = means + 3 * gaussian
                centre_x += _blend(weight, tl.load(at, mask=valid, other=0.0))
                centre_y += _blend(weight, tl.load(at + 1, mask=valid, other=0.0))
                centre_z += _blend(weight, tl.load(at + 2, mask=valid, other=0.0))
        if BLOCK_C > 0:
            value = tl.load(
                features + gaussian[None, :] * channels + c[:, None],
                mask=valid[None, :] & (c < channels)[:, None],
                other=0.0,
            )
            sums = tl.dot(value, weight, sums, input_precision=PRECISION)
        left = left * tl.min(passed, axis=0)  # the last row of the scan, which is decreasing
        done += 1
    plane = width * height
    to = images + y * width + x
    if block == 0:
        tl.store(to, red, mask=inside)
        tl.store(to + plane, green, mask=inside)
        tl.store(to + 2 * plane, blue, mask=inside)
        tl.store(to + 3 * plane, depth, mask=inside)
        tl.store(to + 4 * plane, 1.0 - left, mask=inside)
        if CENTRES:
            to_centres = centre_images + y * width + x
            tl.store(to_centres, centre_x, mask=inside)
            tl.store(to_centres + plane, centre_y, mask=inside)
            tl.store(to_centres + 2 * plane, centre_z, mask=inside)
        pixel = tl.arange(0, PIXELS)
        tl.store(transmittance + tile.to(tl.int64) * PIXELS + pixel, left)
        tl.store(batches + tile, done)
    if BLOCK_C > 0:
        first = to[None, :] + (c + BASE).to(tl.int64)[:, None] * plane
        tl.store(first, sums, mask=inside[None, :] & (c < channels)[:, None])
