"""Kernels: reduction of the pairs of each Gaussian in a fixed order, and the chain rule."""

import triton
import triton.language as tl

from toolkit.splatting.rendering.cuda.differentiation import SUMS
from toolkit.splatting.rendering.cuda.projection import SPLAT

POSE = tl.constexpr(12)


@triton.jit
def _pose_sum(pose, entry: tl.constexpr, values, valid):
    """Write a block's float64 sum for one entry of the pose's gradient."""
    total = tl.sum(tl.where(valid, values, 0.0), axis=0)
    tl.store(pose + tl.program_id(0) * POSE + entry, total)


@triton.jit(do_not_specialize=["visible"])
def finish(
    view,
    means,
    splats,
    ids,
    begins,
    counts,
    pair_tiles,
    sums,
    by_means,
    by_log_radii,
    by_opacity_logits,
    by_colours,
    pose,
    visible,
    tiles_x,
    SIDE: tl.constexpr,
    COLOURS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute gradients of the V visible Gaussians, and of the pose [blocks, 12] float64."""
    j = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = j < visible
    i = tl.load(ids + j, mask=valid, other=0)
    begin = tl.load(begins + j, mask=valid, other=0)
    count = tl.load(counts + j, mask=valid, other=0)
    at = splats + i * SPLAT
    u = tl.load(at, mask=valid, other=0.0)
    v = tl.load(at + 1, mask=valid, other=0.0)
    exponent = tl.load(at + 2, mask=valid, other=-0.5)
    opacity = tl.load(at + 3, mask=valid, other=0.0)
    z = tl.load(at + 7, mask=valid, other=1.0)
    zero = tl.zeros([BLOCK], dtype=tl.float32)
    slope, slope_x, slope_y, slope_square = zero, zero, zero, zero
    by_red, by_green, by_blue, by_depth = zero, zero, zero, zero
    for k in range(tl.max(count, axis=0)):
        mine = k < count
        tile = tl.load(pair_tiles + begin + k, mask=mine, other=0).to(tl.int32)
        row = sums + (begin + k) * SUMS
        # Centre of the splat relative to the tile's centre, the origin of the moments.
        cu = u - (tile % tiles_x * SIDE + (SIDE - 1) * 0.5)
        cv = v - (tile // tiles_x * SIDE + (SIDE - 1) * 0.5)
        m = tl.load(row, mask=mine, other=0.0)
        mx = tl.load(row + 1, mask=mine, other=0.0)
        my = tl.load(row + 2, mask=mine, other=0.0)
        square = tl.load(row + 3, mask=mine, other=0.0)
        dx, dy = mx - cu * m, my - cv * m
        slope += m
        slope_x += dx
        slope_y += dy
        slope_square += square - cu * (mx + dx) - cv * (my + dy)
        by_red += tl.load(row + 4, mask=mine, other=0.0)
        by_green += tl.load(row + 5, mask=mine, other=0.0)
        by_blue += tl.load(row + 6, mask=mine, other=0.0)
        by_depth += tl.load(row + 7, mask=mine, other=0.0)
    fx, fy = tl.load(view + 12), tl.load(view + 13)
    inverse_z, inverse_variance = 1.0 / z, -2.0 * exponent
    by_u, by_v = slope_x * inverse_variance, slope_y * inverse_variance
    by_log_sigma = slope_square * inverse_variance
    px, py = u - tl.load(view + 14), v - tl.load(view + 15)  # fx X / Z, fy Y / Z
    gx, gy = by_u * fx * inverse_z, by_v * fy * inverse_z
    gz = by_depth - (by_u * px + by_v * py + by_log_sigma) * inverse_z
    for k in tl.static_range(3):
        by_mean = tl.load(view + k) * gx + tl.load(view + 4 + k) * gy + tl.load(view + 8 + k) * gz
        tl.store(by_means + 3 * j + k, by_mean, mask=valid)
    tl.store(by_log_radii + j, by_log_sigma, mask=valid)
    tl.store(by_opacity_logits + j, slope * (1.0 - opacity), mask=valid)
    if COLOURS:
        tl.store(by_colours + 3 * j, by_red, mask=valid)
        tl.store(by_colours + 3 * j + 1, by_green, mask=valid)
        tl.store(by_colours + 3 * j + 2, by_blue, mask=valid)
    gx64, gy64, gz64 = gx.to(tl.float64), gy.to(tl.float64), gz.to(tl.float64)
    for k in tl.static_range(3):
        mean = tl.load(means + 3 * i + k, mask=valid, other=0.0).to(tl.float64)
        _pose_sum(pose, k, gx64 * mean, valid)
        _pose_sum(pose, 4 + k, gy64 * mean, valid)
        _pose_sum(pose, 8 + k, gz64 * mean, valid)
    _pose_sum(pose, 3, gx64, valid)
    _pose_sum(pose, 7, gy64, valid)
    _pose_sum(pose, 11, gz64, valid)


@triton.jit(do_not_specialize=["visible"])
def add_rows(
    begins,
    counts,
    rows,
    out,
    visible,
    width,
    stride,
    first,
    BLOCK: tl.constexpr,
    BLOCK_C: tl.constexpr,
):
    """Sum the rows [P, width] of each Gaussian into columns first:first + width of [V, stride]."""
    j = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.program_id(1) * BLOCK_C + tl.arange(0, BLOCK_C)
    valid = j < visible
    begin = tl.load(begins + j, mask=valid, other=0)
    count = tl.load(counts + j, mask=valid, other=0)
    total = tl.zeros([BLOCK, BLOCK_C], dtype=tl.float32)
    for k in range(tl.max(count, axis=0)):
        mine = (k < count)[:, None] & (c < width)[None, :]
        total += tl.load(rows + (begin + k)[:, None] * width + c[None, :], mask=mine, other=0.0)
    to = out + j[:, None] * stride + first + c[None, :]
    tl.store(to, total, mask=valid[:, None] & (c < width)[None, :])
