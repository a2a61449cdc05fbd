"""Kernels: front-to-back compositing of one tile a program, and its gradients (H-19, G-1).

A batch of Gaussians by the pixels of a tile is a matrix of weights. Sums over Gaussians
(forward) and over pixels (backward) are then matrix products, which tensor cores do; the
transmittance is a product scan along the batch.
"""

import triton
import triton.language as tl

from toolkit.rendering.backend import ALPHA_CUT as _ALPHA_CUT
from toolkit.rendering.backend import ALPHA_MAX as _ALPHA_MAX
from toolkit.rendering.backend import TRANSMITTANCE_CUT as _TRANSMITTANCE_CUT
from toolkit.rendering.cuda.projection import SPLAT

ALPHA_CUT = tl.constexpr(_ALPHA_CUT)
ALPHA_MAX = tl.constexpr(_ALPHA_MAX)
TRANSMITTANCE_CUT = tl.constexpr(_TRANSMITTANCE_CUT)
BASE = tl.constexpr(5)  # red, green, blue, depth, silhouette
SUMS = tl.constexpr(8)  # floats a pair; see `differentiate`
TF32_BITS = tl.constexpr(-8192)  # all but the 13 bits that tf32 drops
WIDE = tl.constexpr(16)  # the least width of a matrix product


@triton.jit
def _pixels(tile, tiles_x, width, height, SIDE: tl.constexpr):
    """Column and row of a tile's pixels, and which of them are in the image."""
    pixel = tl.arange(0, SIDE * SIDE)
    x = tile % tiles_x * SIDE + pixel % SIDE
    y = tile // tiles_x * SIDE + pixel // SIDE
    return x, y, (x < width) & (y < height)


@triton.jit
def _alphas(splats, gaussian, valid, x, y):
    """Alphas [batch, pixels] before they are cut and capped, 0 beyond the tile's pairs."""
    at = splats + gaussian * SPLAT
    u = tl.load(at, mask=valid, other=0.0)
    v = tl.load(at + 1, mask=valid, other=0.0)
    exponent = tl.load(at + 2, mask=valid, other=0.0)
    opacity = tl.load(at + 3, mask=valid, other=0.0)
    dx = x.to(tl.float32)[None, :] - u[:, None]
    dy = y.to(tl.float32)[None, :] - v[:, None]
    return opacity[:, None] * tl.exp(exponent[:, None] * (dx * dx + dy * dy))


@triton.jit
def _checkpoint(begin, tile, BATCH: tl.constexpr):
    """Where a tile's first checkpoint lies: its batches never reach the next tile's."""
    return begin // BATCH + tile


@triton.jit
def composite(
    splats,
    features,
    means,
    pair_gaussians,
    tile_begins,
    images,
    checkpoints,
    transmittance,
    batches,
    tiles_x,
    width,
    height,
    channels,
    centres_at,
    SIDE: tl.constexpr,
    BATCH: tl.constexpr,
    BLOCK_C: tl.constexpr,
    CENTRES: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Images [5 + S (+ 3), H, W] of one tile; program axis 1 is a block of feature channels.

    For backward: the transmittance [tiles, pixels] left over, and before every batch
    [checkpoints, pixels]; the number of batches [tiles] until the tile went dark.
    BLOCK_C is 0 without features.
    """
    tile, block = tl.program_id(0), tl.program_id(1)
    x, y, inside = _pixels(tile, tiles_x, width, height, SIDE)
    begin, end = tl.load(tile_begins + tile), tl.load(tile_begins + tile + 1)
    pixel = tl.arange(0, SIDE * SIDE)
    checkpoint = checkpoints + _checkpoint(begin, tile, BATCH).to(tl.int64) * (SIDE * SIDE) + pixel
    left = inside.to(tl.float32)
    red = tl.zeros([SIDE * SIDE], dtype=tl.float32)
    green, blue, depth = red, red, red
    centre_x, centre_y, centre_z = red, red, red
    if BLOCK_C > 0:
        c = block * BLOCK_C + tl.arange(0, BLOCK_C)
        sums = tl.zeros([BLOCK_C, SIDE * SIDE], dtype=tl.float32)
    done = 0
    while (begin + done * BATCH < end) & (tl.max(left, axis=0) >= TRANSMITTANCE_CUT):
        pair = begin + done * BATCH + tl.arange(0, BATCH)
        valid = pair < end
        gaussian = tl.load(pair_gaussians + pair, mask=valid, other=0).to(tl.int64)
        alpha = _alphas(splats, gaussian, valid, x, y)
        alpha = tl.where(alpha >= ALPHA_CUT, tl.minimum(alpha, ALPHA_MAX), 0.0)
        keep = 1.0 - alpha
        passed = tl.cumprod(keep, axis=0)
        weight = alpha * (left[None, :] * passed / keep)
        if block == 0:
            tl.store(checkpoint + done * (SIDE * SIDE), left)
            at = splats + gaussian * SPLAT
            r = tl.load(at + 4, mask=valid, other=0.0)
            g = tl.load(at + 5, mask=valid, other=0.0)
            b = tl.load(at + 6, mask=valid, other=0.0)
            z = tl.load(at + 7, mask=valid, other=0.0)
            red += tl.sum(weight * r[:, None], axis=0)
            green += tl.sum(weight * g[:, None], axis=0)
            blue += tl.sum(weight * b[:, None], axis=0)
            depth += tl.sum(weight * z[:, None], axis=0)
            if CENTRES:
                mx = tl.load(means + 3 * gaussian, mask=valid, other=0.0)
                my = tl.load(means + 3 * gaussian + 1, mask=valid, other=0.0)
                mz = tl.load(means + 3 * gaussian + 2, mask=valid, other=0.0)
                centre_x += tl.sum(weight * mx[:, None], axis=0)
                centre_y += tl.sum(weight * my[:, None], axis=0)
                centre_z += tl.sum(weight * mz[:, None], axis=0)
        if BLOCK_C > 0:
            value = tl.load(
                features + gaussian[None, :] * channels + c[:, None],
                mask=valid[None, :] & (c < channels)[:, None],
                other=0.0,
            )
            sums = tl.dot(value, weight, sums, input_precision=PRECISION)
        left = left * tl.min(passed, axis=0)  # the scan's last row: it never grows
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
            first = to + centres_at
            tl.store(first, centre_x, mask=inside)
            tl.store(first + plane, centre_y, mask=inside)
            tl.store(first + 2 * plane, centre_z, mask=inside)
        tl.store(transmittance + tile.to(tl.int64) * (SIDE * SIDE) + pixel, left)
        tl.store(batches + tile, done)
    if BLOCK_C > 0:
        first = to[None, :] + (c + BASE).to(tl.int64)[:, None] * plane
        tl.store(first, sums, mask=inside[None, :] & (c < channels)[:, None])


@triton.jit
def _moments(x, y, tile, tiles_x, SIDE: tl.constexpr):
    """Columns 1, x, y, x^2 + y^2 of a tile's pixels, seen from its centre, [pixels, 16].

    All of them are exact in tf32, so that the products lose nothing on this side.
    """
    column = tl.arange(0, WIDE)[None, :]
    px = (x - tile % tiles_x * SIDE).to(tl.float32)[:, None] - (SIDE - 1) * 0.5
    py = (y - tile // tiles_x * SIDE).to(tl.float32)[:, None] - (SIDE - 1) * 0.5
    return (
        tl.where(column == 0, 1.0, 0.0)
        + tl.where(column == 1, px, 0.0)
        + tl.where(column == 2, py, 0.0)
        + tl.where(column == 3, px * px + py * py, 0.0)
    )


@triton.jit
def _clear(
    pair_rows,
    begin,
    end,
    sums,
    feature_rows,
    width,
    BATCH: tl.constexpr,
    BLOCK_C: tl.constexpr,
    GEOMETRY: tl.constexpr,
):
    """Pairs behind everything that was drawn own a row, too, and it must read zero."""
    for start in range(begin, end, BATCH):
        pair = start + tl.arange(0, BATCH)
        row = tl.load(pair_rows + pair, mask=pair < end, other=0)[:, None]
        valid = (pair < end)[:, None]
        if GEOMETRY:
            entry = row * SUMS + tl.arange(0, SUMS)[None, :]
            tl.store(sums + entry, tl.zeros([BATCH, SUMS], dtype=tl.float32), mask=valid)
        if BLOCK_C > 0:
            for c in range(0, width, BLOCK_C):
                column = c + tl.arange(0, BLOCK_C)[None, :]
                nothing = tl.zeros([BATCH, BLOCK_C], dtype=tl.float32)
                tl.store(
                    feature_rows + row * width + column, nothing, mask=valid & (column < width)
                )


@triton.jit
def differentiate(
    splats,
    features,
    pair_gaussians,
    pair_rows,
    tile_begins,
    checkpoints,
    transmittance,
    batches,
    by_images,
    sums,
    feature_rows,
    tiles_x,
    width,
    height,
    channels,
    first,
    last,
    SIDE: tl.constexpr,
    BATCH: tl.constexpr,
    BLOCK_C: tl.constexpr,
    GEOMETRY: tl.constexpr,
    MOVE: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Sums of every pair of one tile, back to front, each in the row that the pair owns.

    sums [P, 8]: alpha dL/dalpha times 1, x, y, x^2 + y^2 (pixels from the tile's centre),
    then weight times dL/d(red, green, blue, depth). feature_rows [P, last - first]: dL/df of
    the feature channels from `first` to `last`. With w_k = alpha_k T_k and d = dL/d(pixel),
    dL/dalpha_k = T_k <f_k, d> - S_k / (1 - alpha_k), where S_k sums w_j <f_j, d> over all j
    behind k and starts with what the silhouette asks. MOVE: f and d include the feature
    channels. Without GEOMETRY only the feature rows are written.
    """
    tile = tl.program_id(0)
    x, y, inside = _pixels(tile, tiles_x, width, height, SIDE)
    begin, end = tl.load(tile_begins + tile), tl.load(tile_begins + tile + 1)
    used = tl.load(batches + tile)
    pixel = tl.arange(0, SIDE * SIDE)
    checkpoint = checkpoints + _checkpoint(begin, tile, BATCH).to(tl.int64) * (SIDE * SIDE) + pixel
    plane = width * height
    asked = by_images + y * width + x
    wide = tl.arange(0, WIDE)
    if GEOMETRY:
        basis = _moments(x, y, tile, tiles_x, SIDE)
        by_base = tl.load(
            asked[:, None] + (wide - 4)[None, :] * plane,
            mask=inside[:, None] & ((wide >= 4) & (wide < SUMS))[None, :],
            other=0.0,
        )
        by_red = tl.load(asked, mask=inside, other=0.0)
        by_green = tl.load(asked + plane, mask=inside, other=0.0)
        by_blue = tl.load(asked + 2 * plane, mask=inside, other=0.0)
        by_depth = tl.load(asked + 3 * plane, mask=inside, other=0.0)
        behind = -tl.load(transmittance + tile.to(tl.int64) * (SIDE * SIDE) + pixel)
        behind *= tl.load(asked + 4 * plane, mask=inside, other=0.0)
    _clear(
        pair_rows,
        begin + used * BATCH,
        end,
        sums,
        feature_rows,
        last - first,
        BATCH,
        BLOCK_C,
        GEOMETRY,
    )
    for i in range(used):
        number = used - 1 - i
        pair = begin + number * BATCH + tl.arange(0, BATCH)
        valid = pair < end
        gaussian = tl.load(pair_gaussians + pair, mask=valid, other=0).to(tl.int64)
        row = tl.load(pair_rows + pair, mask=valid, other=0)
        raw = _alphas(splats, gaussian, valid, x, y)
        alpha = tl.where(raw >= ALPHA_CUT, tl.minimum(raw, ALPHA_MAX), 0.0)
        keep = 1.0 - alpha
        # As in the forward pass, bit for bit: no division by what was let through.
        left = tl.load(checkpoint + number * (SIDE * SIDE))
        before = left[None, :] * tl.cumprod(keep, axis=0) / keep
        weight = alpha * before
        product = tl.zeros([BATCH, SIDE * SIDE], dtype=tl.float32)
        if BLOCK_C > 0:
            stop = channels if MOVE else last
            for start in range(0 if MOVE else first, stop, BLOCK_C):
                c = start + tl.arange(0, BLOCK_C)
                by_feature = tl.load(
                    asked[None, :] + (c + BASE).to(tl.int64)[:, None] * plane,
                    mask=inside[None, :] & (c < channels)[:, None],
                    other=0.0,
                )
                if MOVE:
                    value = tl.load(
                        features + gaussian[:, None] * channels + c[None, :],
                        mask=valid[:, None] & (c < channels)[None, :],
                        other=0.0,
                    )
                    product = tl.dot(value, by_feature, product, input_precision=PRECISION)
                by_value = tl.dot(weight, tl.trans(by_feature), input_precision=PRECISION)
                to = feature_rows + row[:, None] * (last - first) + (c - first)[None, :]
                mine = (c >= first) & (c < last)
                tl.store(to, by_value, mask=valid[:, None] & mine[None, :])
        if GEOMETRY:
            at = splats + gaussian * SPLAT
            product += tl.load(at + 4, mask=valid, other=0.0)[:, None] * by_red[None, :]
            product += tl.load(at + 5, mask=valid, other=0.0)[:, None] * by_green[None, :]
            product += tl.load(at + 6, mask=valid, other=0.0)[:, None] * by_blue[None, :]
            product += tl.load(at + 7, mask=valid, other=0.0)[:, None] * by_depth[None, :]
            own = weight * product
            after = behind[None, :] + (tl.cumsum(own, axis=0, reverse=True) - own)
            free = (raw >= ALPHA_CUT) & (raw < ALPHA_MAX)
            slope = tl.where(free, (before * product - after / keep) * alpha, 0.0)
            behind += tl.sum(own, axis=0)
            # The moments cancel in the chain rule, so they keep 22 bits: two products, since the
            # basis is exact in tf32. A third would hold twice the registers.
            coarse = (slope.to(tl.int32, bitcast=True) & TF32_BITS).to(tl.float32, bitcast=True)
            found = tl.dot(slope - coarse, basis, input_precision="tf32")
            found = tl.dot(coarse, basis, found, input_precision="tf32")
            found = tl.dot(weight, by_base, found, input_precision=PRECISION)
            entry = row[:, None] * SUMS + wide[None, :]
            tl.store(sums + entry, found, mask=valid[:, None] & (wide < SUMS)[None, :])
