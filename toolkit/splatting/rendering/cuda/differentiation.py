"""Kernel: gradients of one tile per program, back to front.

Sums over pixels are matrix products, like the sums over Gaussians in compositing.
"""

import triton
import triton.language as tl

from toolkit.splatting.rendering.cuda.tiles import (
    BASE,
    MAX_ALPHA,
    MIN_ALPHA,
    alphas_of,
    checkpoints_of,
    colour_and_depth,
    cut,
    depths_of,
    pixels_of,
    splats_at,
)

SUMS = tl.constexpr(8)  # floats per pair; see `differentiate`
SHAPED_SUMS = tl.constexpr(12)
TF32_BITS = tl.constexpr(-8192)  # mask without the 13 bits that TF32 drops
WIDE = tl.constexpr(16)  # minimum width of a matrix product


@triton.jit
def _moments(SIDE: tl.constexpr):
    """Return 1, x, y, x^2 + y^2 of a tile's pixels relative to its centre, as columns [pixels, 16].

    All values are exact in TF32.
    """
    column = tl.arange(0, WIDE)[None, :]
    pixel = tl.arange(0, SIDE * SIDE)
    px = (pixel % SIDE).to(tl.float32)[:, None] - (SIDE - 1) * 0.5
    py = (pixel // SIDE).to(tl.float32)[:, None] - (SIDE - 1) * 0.5
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
    WIDTH: tl.constexpr,
    BLOCK_C: tl.constexpr,
    GEOMETRY: tl.constexpr,
):
    """Write zeros to the rows of pairs behind the last composited batch."""
    for start in range(begin, end, BATCH):
        pair = start + tl.arange(0, BATCH)
        row = tl.load(pair_rows + pair, mask=pair < end, other=0)[:, None]
        valid = (pair < end)[:, None]
        if GEOMETRY:
            COLUMNS: tl.constexpr = SUMS if WIDTH == SUMS else WIDE
            entry = tl.arange(0, COLUMNS)[None, :]
            empty = tl.zeros([BATCH, COLUMNS], dtype=tl.float32)
            tl.store(sums + row * WIDTH + entry, empty, mask=valid & (entry < WIDTH))
        if BLOCK_C > 0:
            for c in range(0, width, BLOCK_C):
                column = c + tl.arange(0, BLOCK_C)[None, :]
                nothing = tl.zeros([BATCH, BLOCK_C], dtype=tl.float32)
                tl.store(
                    feature_rows + row * width + column, nothing, mask=valid & (column < width)
                )


@triton.jit
def _by_features(
    pixel_gradients,
    inside,
    plane,
    features,
    gaussian,
    valid,
    weight,
    feature_rows,
    row,
    channels,
    first,
    last,
    BLOCK_C: tl.constexpr,
    MOVE: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Write the feature rows of a batch; return <f, d> [batch, pixels], 0 without MOVE."""
    product = tl.zeros(weight.shape, dtype=tl.float32)
    stop = channels if MOVE else last
    for start in range(0 if MOVE else first, stop, BLOCK_C):
        c = start + tl.arange(0, BLOCK_C)
        by_feature = tl.load(
            pixel_gradients[None, :] + (c + BASE).to(tl.int64)[:, None] * plane,
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
    return product


@triton.jit
def _slopes(raw, before, product, behind):
    """Compute alpha dL/dalpha [batch, pixels] and the updated sum [pixels] for the next batch.

    Args:
        raw: alphas [batch, pixels] before thresholding.
        before: transmittance [batch, pixels] in front of each Gaussian.
        product: <f, d> [batch, pixels].
        behind: sum [pixels] of w <f, d> over all Gaussians behind the batch.
    """
    alpha, keep = cut(raw)
    own = alpha * before * product
    after = behind[None, :] + (tl.cumsum(own, axis=0, reverse=True) - own)
    free = (raw >= MIN_ALPHA) & (raw < MAX_ALPHA)
    slope = tl.where(free, (before * product - after / keep) * alpha, 0.0)
    return slope, behind + tl.sum(own, axis=0)


@triton.jit
def _in_moments(slope, basis):
    """Compute slope @ basis with 22 bits of the slope, because the chain rule subtracts moments.

    Two products suffice, because the basis is exact in TF32. A third would double the registers.
    """
    coarse = (slope.to(tl.int32, bitcast=True) & TF32_BITS).to(tl.float32, bitcast=True)
    found = tl.dot(slope - coarse, basis, input_precision="tf32")
    return tl.dot(coarse, basis, found, input_precision="tf32")


@triton.jit
def _column(values, ones, column: tl.constexpr):
    """Return the sums of values [batch, pixels] over pixels as one column of [batch, 16]."""
    return tl.where(tl.arange(0, WIDE)[None, :] == column, _in_moments(values, ones), 0.0)


@triton.jit
def _shaped_moments(slope, by_depth, s, t, ones):
    """Return sums over pixels [batch, 16].

    Columns 0 to 3 sum the slope times 1, s, t, s^2; columns 8 and 9 the slope times s t, t^2;
    columns 10 and 11 by_depth times s, t.
    """
    in_s, in_t = slope * s, slope * t
    found = _column(slope, ones, 0) + _column(in_s, ones, 1) + _column(in_t, ones, 2)
    found += _column(in_s * s, ones, 3) + _column(in_s * t, ones, 8) + _column(in_t * t, ones, 9)
    return found + _column(by_depth * s, ones, 10) + _column(by_depth * t, ones, 11)


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
    SHAPED: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Compute the sums of every pair of one tile, back to front, and write them to its row.

    sums [P, 8]: alpha dL/dalpha times 1, x, y, x^2 + y^2 (pixels from the tile's centre),
    then weight times dL/d(red, green, blue, depth). If SHAPED, [P, 12]: alpha dL/dalpha times
    1, s, t, s^2, then the same four, alpha dL/dalpha times s t, t^2, and weight times dL/d(depth)
    times s, t. feature_rows [P, last - first]: dL/df of
    the feature channels from `first` to `last`. With w_k = alpha_k T_k and d = dL/d(pixel),
    dL/dalpha_k = T_k <f_k, d> - S_k / (1 - alpha_k), where S_k sums w_j <f_j, d> over all j
    behind k, starting with the term of the silhouette. With MOVE, f and d include the feature
    channels. Without GEOMETRY only the feature rows are written.
    """
    PIXELS: tl.constexpr = SIDE * SIDE
    WIDTH: tl.constexpr = SHAPED_SUMS if SHAPED else SUMS
    tile = tl.program_id(0)
    x, y, inside = pixels_of(tile, width, height, SIDE)
    begin, end = tl.load(tile_begins + tile), tl.load(tile_begins + tile + 1)
    used = tl.load(batches + tile)
    checkpoint = checkpoints_of(checkpoints, begin, tile, BATCH, PIXELS)
    plane = width * height
    pixel_gradients = by_images + y * width + x
    wide = tl.arange(0, WIDE)
    if GEOMETRY:
        basis = tl.full([PIXELS, WIDE], 1.0, dtype=tl.float32) if SHAPED else _moments(SIDE)
        by_base = tl.load(
            pixel_gradients[:, None] + (wide - 4)[None, :] * plane,
            mask=inside[:, None] & ((wide >= 4) & (wide < 8))[None, :],
            other=0.0,
        )
        by_red = tl.load(pixel_gradients, mask=inside, other=0.0)
        by_green = tl.load(pixel_gradients + plane, mask=inside, other=0.0)
        by_blue = tl.load(pixel_gradients + 2 * plane, mask=inside, other=0.0)
        by_depth = tl.load(pixel_gradients + 3 * plane, mask=inside, other=0.0)
        left_over = tl.load(transmittance + tile.to(tl.int64) * PIXELS + tl.arange(0, PIXELS))
        behind = -left_over * tl.load(pixel_gradients + 4 * plane, mask=inside, other=0.0)
    rest = begin + used * BATCH
    _clear(pair_rows, rest, end, sums, feature_rows, last - first, BATCH, WIDTH, BLOCK_C, GEOMETRY)
    for i in range(used):
        number = used - 1 - i
        pair = begin + number * BATCH + tl.arange(0, BATCH)
        valid = pair < end
        gaussian = tl.load(pair_gaussians + pair, mask=valid, other=0).to(tl.int64)
        row = tl.load(pair_rows + pair, mask=valid, other=0)
        splat = splats_at(splats, gaussian, SHAPED)
        raw, s, t = alphas_of(splat, valid, x, y, SHAPED)
        alpha, keep = cut(raw)
        # From what the forward pass left here: no division by what was let through.
        left = tl.load(checkpoint + number * PIXELS)
        before = left[None, :] * tl.cumprod(keep, axis=0) / keep
        weight = alpha * before
        product = tl.zeros([BATCH, PIXELS], dtype=tl.float32)
        if BLOCK_C > 0:
            product = _by_features(
                pixel_gradients,
                inside,
                plane,
                features,
                gaussian,
                valid,
                weight,
                feature_rows,
                row,
                channels,
                first,
                last,
                BLOCK_C,
                MOVE,
                PRECISION,
            )
        if GEOMETRY:
            r, g, b, z = colour_and_depth(splat, valid)
            product += r[:, None] * by_red[None, :]
            product += g[:, None] * by_green[None, :]
            product += b[:, None] * by_blue[None, :]
            product += depths_of(splat, valid, z, s, t, SHAPED) * by_depth[None, :]
            slope, behind = _slopes(raw, before, product, behind)
            if SHAPED:
                found = _shaped_moments(slope, weight * by_depth[None, :], s, t, basis)
            else:
                found = _in_moments(slope, basis)
            found = tl.dot(weight, by_base, found, input_precision=PRECISION)
            entry = row[:, None] * WIDTH + wide[None, :]
            tl.store(sums + entry, found, mask=valid[:, None] & (wide < WIDTH)[None, :])
