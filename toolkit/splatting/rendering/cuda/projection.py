"""Kernels: projection of Gaussians, and the pairs of Gaussians and intersected tiles."""

import triton
import triton.language as tl

from toolkit.base.native import constants

NEAR_M = tl.constexpr(constants.NEAR_M)
MIN_ALPHA = tl.constexpr(constants.MIN_ALPHA)
REGION_TILE = tl.constexpr(constants.TILE)
MIN_SIGMA_PX = tl.constexpr(constants.MIN_SIGMA_PX)
MIN_FACTOR = tl.constexpr(5e-16)  # of a covariance whose determinant is 1e30, as in C++
SPLAT = tl.constexpr(8)  # floats: u, v, exponent, opacity, red, green, blue, depth; one sector
SHAPED_SPLAT = tl.constexpr(12)  # see `ellipsoids.splats_of`
VIEW = 16  # floats: rows of [R | t], then fx, fy, cx, cy


@triton.jit
def _in_region(region, x, y, columns, within, SIDE: tl.constexpr):
    """Check whether tiles (x, y) of SIDE pixels are in the region."""
    at = (y * SIDE // REGION_TILE) * columns + x * SIDE // REGION_TILE
    return within & (tl.load(region + at, mask=within, other=0) != 0)


@triton.jit
def _cover(
    outline,
    seen,
    region,
    rectangles,
    counts,
    sizes,
    SIDE: tl.constexpr,
    HAS_REGION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write tile rectangles and counts of a block of Gaussians; return which of them are visible.

    Args:
        outline: centres u, v and half extents in x and y [block], in pixels.
        seen: Gaussians [block] that may be visible.
        sizes: number of Gaussians, width and height of the image, tile columns of the region.
    """
    u, v, across, down = outline
    count, width, height, region_columns = sizes
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    # Pixels whose centres lie within the support, clamped before they become integers.
    left = tl.ceil(tl.minimum(tl.maximum(u - across, 0.0), width * 1.0))
    top = tl.ceil(tl.minimum(tl.maximum(v - down, 0.0), height * 1.0))
    right = tl.floor(tl.minimum(tl.maximum(u + across, -1.0), width - 1.0))
    bottom = tl.floor(tl.minimum(tl.maximum(v + down, -1.0), height - 1.0))
    seen = seen & (left <= right) & (top <= bottom)
    tile_x = tl.where(seen, left, 0.0).to(tl.int32) // SIDE
    tile_y = tl.where(seen, top, 0.0).to(tl.int32) // SIDE
    columns = tl.where(seen, right, 0.0).to(tl.int32) // SIDE - tile_x + 1
    rows = tl.where(seen, bottom, 0.0).to(tl.int32) // SIDE - tile_y + 1
    area = tl.where(seen, columns * rows, 0)
    tiles = area
    if HAS_REGION:
        tiles = tl.zeros([BLOCK], dtype=tl.int32)
        for k in range(tl.max(area, axis=0)):
            inside = _in_region(
                region, tile_x + k % columns, tile_y + k // columns, region_columns, k < area, SIDE
            )
            tiles += inside.to(tl.int32)
    tl.store(counts + i, tiles, mask=i < count)
    seen = seen & (tiles > 0)
    at = rectangles + 4 * i
    tl.store(at, tile_x.to(tl.int16), mask=seen)
    tl.store(at + 1, tile_y.to(tl.int16), mask=seen)
    tl.store(at + 2, columns.to(tl.int16), mask=seen)
    tl.store(at + 3, rows.to(tl.int16), mask=seen)
    return seen


# Not specialised on the number of Gaussians (by default, multiples of 16 get separate kernels):
# it changes as the map grows, and each specialisation takes seconds to compile.
@triton.jit(do_not_specialize=["count"])
def project(
    view,
    means,
    log_radii,
    opacity_logits,
    colours,
    region,
    splats,
    rectangles,
    counts,
    count,
    width,
    height,
    region_columns,
    SIDE: tl.constexpr,
    HAS_REGION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute splats [N, 8], tile rectangles [N, 4] (x, y, columns, rows) and tile counts [N].

    The count of an invisible Gaussian is 0 and its other values are not written.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    mx = tl.load(means + 3 * i, mask=valid, other=0.0)
    my = tl.load(means + 3 * i + 1, mask=valid, other=0.0)
    mz = tl.load(means + 3 * i + 2, mask=valid, other=0.0)
    x = tl.load(view) * mx + tl.load(view + 1) * my + tl.load(view + 2) * mz + tl.load(view + 3)
    y = tl.load(view + 4) * mx + tl.load(view + 5) * my + tl.load(view + 6) * mz + tl.load(view + 7)
    z = tl.load(view + 8) * mx + tl.load(view + 9) * my + tl.load(view + 10) * mz
    z += tl.load(view + 11)
    fx, fy = tl.load(view + 12), tl.load(view + 13)
    ahead = valid & (z > NEAR_M)
    inverse_z = 1.0 / tl.where(ahead, z, 1.0)
    u = fx * x * inverse_z + tl.load(view + 14)
    v = fy * y * inverse_z + tl.load(view + 15)
    log_radius = tl.load(log_radii + i, mask=valid, other=0.0)
    sigma = tl.sqrt(fx * fy) * tl.exp(log_radius) * inverse_z
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(opacity_logits + i, mask=valid, other=0.0)))
    # Comparisons with NaN are false, so Gaussians with NaN are invisible.
    seen = ahead & (opacity > MIN_ALPHA) & (sigma > MIN_SIGMA_PX)
    # Slightly enlarged, so that rounding never removes pixels that pass the alpha test.
    reach = tl.log(tl.where(seen, opacity, 1.0) / MIN_ALPHA)
    support = tl.sqrt(2.0 * sigma * sigma * reach * 1.0001 + 1e-6)
    seen = _cover(
        (u, v, support, support),
        seen,
        region,
        rectangles,
        counts,
        (count, width, height, region_columns),
        SIDE,
        HAS_REGION,
        BLOCK,
    )
    at = splats + i * SPLAT
    tl.store(at, u, mask=seen)
    tl.store(at + 1, v, mask=seen)
    tl.store(at + 2, -0.5 / (sigma * sigma), mask=seen)
    tl.store(at + 3, opacity, mask=seen)
    for c in tl.static_range(3):
        colour = tl.load(colours + 3 * i + c, mask=seen, other=0.0)
        tl.store(at + 4 + c, colour, mask=seen)
    tl.store(at + 7, z, mask=seen)


@triton.jit
def _shape(splat, valid):
    """Load a, b, c and the maximum of s^2 + t^2 [block] of pixels that pass the alpha test.

    The latter is slightly enlarged, so that rounding never removes pixels.
    """
    a = tl.load(splat + 2, mask=valid, other=1.0)
    b = tl.load(splat + 8, mask=valid, other=0.0)
    c = tl.load(splat + 9, mask=valid, other=1.0)
    opacity = tl.load(splat + 3, mask=valid, other=1.0)
    return a, b, c, tl.log(tl.maximum(opacity, MIN_ALPHA) / MIN_ALPHA) * 1.001 + 1e-4


@triton.jit
def _touches(shape, dx, dy, SIDE: tl.constexpr):
    """Check whether ellipses touch tiles, whose first pixels are at (dx, dy) from the centres."""
    a, b, c, support = shape
    right, bottom = dx + (SIDE - 1), dy + (SIDE - 1)
    # The nearest point lies on an edge that faces the centre, or is the centre.
    x = tl.minimum(tl.maximum(0.0, dx), right)
    y = tl.minimum(tl.maximum(0.0, dy), bottom)
    down = tl.minimum(tl.maximum(-a * b / (b * b + c * c) * x, dy), bottom)
    across = tl.minimum(tl.maximum(-b / a * y, dx), right)
    beside, above = a * x + b * down, a * across + b * y
    least = tl.minimum(beside * beside + c * c * down * down, above * above + c * c * y * y)
    return least <= support


@triton.jit(do_not_specialize=["count"])
def cover(
    splats,
    region,
    rectangles,
    counts,
    count,
    width,
    height,
    region_columns,
    SIDE: tl.constexpr,
    HAS_REGION: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute tile rectangles [N, 4] and tile counts [N] of splats [N, 12], as `project` does."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < count
    at = splats + i * SHAPED_SPLAT
    u, v = tl.load(at, mask=valid, other=0.0), tl.load(at + 1, mask=valid, other=0.0)
    opacity = tl.load(at + 3, mask=valid, other=0.0)
    z = tl.load(at + 7, mask=valid, other=0.0)
    a, b, c, support = _shape(at, valid)
    # The determinant of the covariance is 1 / (2 a c)^2, and its trace is in proportion to it and
    # a^2 + b^2 + c^2. Comparisons with NaN are false, so Gaussians with NaN are invisible.
    thick = a * a + b * b + c * c < 0.5 / (MIN_SIGMA_PX * MIN_SIGMA_PX)
    seen = valid & (z > NEAR_M) & (opacity > MIN_ALPHA) & thick & (a * c > MIN_FACTOR)
    a, c, support = tl.where(seen, a, 1.0), tl.where(seen, c, 1.0), tl.where(seen, support, 0.0)
    across, down = tl.sqrt(support * (1.0 + b * b / (c * c))) / a, tl.sqrt(support) / c
    _cover(
        (u, v, across, down),
        seen,
        region,
        rectangles,
        counts,
        (count, width, height, region_columns),
        SIDE,
        HAS_REGION,
        BLOCK,
    )


@triton.jit(do_not_specialize=["visible"])
def list_pairs(
    splats,
    gaussians,
    begins,
    rectangles,
    region,
    pair_tiles,
    pair_gaussians,
    visible,
    tiles_x,
    tiles,
    region_columns,
    SIDE: tl.constexpr,
    HAS_REGION: tl.constexpr,
    SHAPED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """List tile [P] and Gaussian [P] of every pair; the pairs of one Gaussian are contiguous.

    The pairs of the Gaussian `gaussians[j]` start at index `begins[j]`. Tiles that an ellipse does
    not touch are listed as the tile behind the last one, which is not rendered.
    """
    j = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = j < visible
    i = tl.load(gaussians + j, mask=valid, other=0)
    place = tl.load(begins + j, mask=valid, other=0)
    at = rectangles + 4 * i
    tile_x = tl.load(at, mask=valid, other=0).to(tl.int32)
    tile_y = tl.load(at + 1, mask=valid, other=0).to(tl.int32)
    columns = tl.load(at + 2, mask=valid, other=1).to(tl.int32)
    area = columns * tl.load(at + 3, mask=valid, other=0).to(tl.int32)
    if SHAPED:
        splat = splats + i * SHAPED_SPLAT
        u, v = tl.load(splat, mask=valid, other=0.0), tl.load(splat + 1, mask=valid, other=0.0)
        shape = _shape(splat, valid)
    for k in range(tl.max(area, axis=0)):
        x, y = tile_x + k % columns, tile_y + k // columns
        inside = k < area
        if HAS_REGION:
            inside = _in_region(region, x, y, region_columns, inside, SIDE)
        tile = y * tiles_x + x
        if SHAPED:
            tile = tl.where(_touches(shape, x * SIDE - u, y * SIDE - v, SIDE), tile, tiles)
        tl.store(pair_tiles + place, tile.to(pair_tiles.dtype.element_ty), mask=inside)
        tl.store(pair_gaussians + place, i.to(tl.int32), mask=inside)
        place += inside.to(tl.int64)
