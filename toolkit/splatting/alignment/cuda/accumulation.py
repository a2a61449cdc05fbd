"""Kernel: the sums of one Gauss-Newton step, whose equations are those of `reference`."""

import triton
import triton.language as tl

from toolkit.base.native import constants

# Columns of the Jacobian: translation, rotation, gain, bias, and the residual; padded to the
# minimum width of a matrix product.
WIDE = tl.constexpr(16)
RESIDUAL = tl.constexpr(8)
# A partial sum is the product J^T J [16, 16]. Its last row, otherwise 0, holds the numbers of
# intensity and depth residuals, their weighted sums of squares, and the number of frame pixels.
TAIL = tl.constexpr(15)
# Places of the scalars: intrinsics of the model view and of the frame, the rows [R | t] of
# T_model_frame, exposure, and the inverse scales.
POSE = tl.constexpr(8)
EXPOSURE = tl.constexpr(20)

STUDENT_T_DOF = tl.constexpr(constants.STUDENT_T_DOF)
MAX_DEPTH_STEP = tl.constexpr(constants.MAX_DEPTH_STEP)
MIN_NOISE_DEPTH_SQUARED = tl.constexpr(constants.MIN_NOISE_DEPTH_M**2)
NEAR_M = tl.constexpr(constants.NEAR_M)


@triton.jit
def _column(columns, place: tl.constexpr, values):
    """Place values [pixels] in one column of a matrix [pixels, 16]."""
    return tl.where(columns == place, values[:, None], 0.0)


@triton.jit
def _pose_columns(columns, direction, point):
    """Derivative of n . Y with respect to a left tangent, in columns 0 to 5."""
    nx, ny, nz = direction
    x, y, z = point
    return (
        _column(columns, 0, nx)
        + _column(columns, 1, ny)
        + _column(columns, 2, nz)
        + _column(columns, 3, y * nz - z * ny)
        + _column(columns, 4, z * nx - x * nz)
        + _column(columns, 5, x * ny - y * nx)
    )


@triton.jit
def _tap(texture, at, usable):
    """Intensity, its derivatives and depth of a texel."""
    value = tl.load(texture + 4 * at, mask=usable, other=0.0)
    along_x = tl.load(texture + 4 * at + 1, mask=usable, other=0.0)
    along_y = tl.load(texture + 4 * at + 2, mask=usable, other=0.0)
    depth = tl.load(texture + 4 * at + 3, mask=usable, other=0.0)
    return value, along_x, along_y, depth


@triton.jit
def _row(scalars, row: tl.constexpr):
    """A row [R | t] of the pose."""
    at = scalars + POSE + 4 * row
    return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)


@triton.jit
def _coordinate(row, depth, rx, ry):
    """One coordinate of points at given depths on the rays (rx, ry, 1), transformed by the pose."""
    return depth * (row[0] * rx + row[1] * ry + row[2]) + row[3]


@triton.jit
def _weights(residual, inverse_scale, counted):
    """Student's t: square roots of the residuals' weights, and their weighted squares."""
    square = residual * inverse_scale * residual * inverse_scale
    robust = tl.where(counted, 1.0 / (square + STUDENT_T_DOF) * (STUDENT_T_DOF + 1.0), 0.0)
    return tl.sqrt(robust) * inverse_scale, robust * square


@triton.jit
def _counted(place, kind: tl.constexpr, counted, squares):
    """Tail [16] with the number and the weighted squares of one type of residual."""
    number = tl.where(place == kind, tl.sum(counted.to(tl.float32), axis=0), 0.0)
    return number + tl.where(place == 2 + kind, tl.sum(squares, axis=0), 0.0)


@triton.jit
def _point_to_plane(columns, surface, at, close, point, seen, inverse_z, inverse_sigma):
    """Jacobian rows with residuals [pixels, 16], mask of valid residuals, and weighted squares.

    Weight and lever arm are computed from the model's depth: with the frame's depth they would
    depend on its noise.
    """
    nx = tl.load(surface + 4 * at, mask=close, other=0.0)
    ny = tl.load(surface + 4 * at + 1, mask=close, other=0.0)
    nz = tl.load(surface + 4 * at + 2, mask=close, other=0.0)
    offset = tl.load(surface + 4 * at + 3, mask=close, other=0.0)
    flat = close & ((nx != 0.0) | (ny != 0.0) | (nz != 0.0))
    x, y, z = point
    residual = tl.where(flat, nx * x + ny * y + nz * z - offset, 0.0)
    # Noise grows with the square of the depth.
    root, squares = _weights(
        residual, inverse_sigma / tl.maximum(seen * seen, MIN_NOISE_DEPTH_SQUARED), flat
    )
    lever = (x * seen * inverse_z, y * seen * inverse_z, seen)
    J = _pose_columns(columns, (nx, ny, nz), lever) + _column(columns, RESIDUAL, residual)
    return tl.where(flat[:, None], J * root[:, None], 0.0), flat, squares


@triton.jit
def _interpolated(texture, surface, width, u, v, close):
    """Interpolated intensity and derivatives [pixels], and whether the taps are on one surface."""
    left, top = u.to(tl.int32), v.to(tl.int32)
    a, b = u - left.to(tl.float32), v - top.to(tl.float32)
    at = top * width + left
    i00, x00, y00, d00 = _tap(texture, at, close)
    i01, x01, y01, d01 = _tap(texture, at + 1, close)
    i10, x10, y10, d10 = _tap(texture, at + width, close)
    i11, x11, y11, d11 = _tap(texture, at + width + 1, close)
    nearest = tl.minimum(tl.minimum(d00, d01), tl.minimum(d10, d11))
    farthest = tl.maximum(tl.maximum(d00, d01), tl.maximum(d10, d11))
    # Opposite taps that lie on planes with all their neighbours join the four.
    plane00 = tl.load(surface + 4 * at + 3, mask=close, other=0.0)
    plane11 = tl.load(surface + 4 * (at + width + 1) + 3, mask=close, other=0.0)
    joined = (plane00 != 0.0) & (plane11 != 0.0)
    bright = close & (nearest > 0.0) & (joined | (farthest - nearest <= nearest * MAX_DEPTH_STEP))
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    value = w00 * i00 + w01 * i01 + w10 * i10 + w11 * i11
    along_x = w00 * x00 + w01 * x01 + w10 * x10 + w11 * x11
    along_y = w00 * y00 + w01 * y01 + w10 * y10 + w11 * y11
    return value, along_x, along_y, bright


@triton.jit
def _photometric(columns, sampled, own, exposure, point, focal, inverse_z, root_weight):
    """See `_point_to_plane`; residuals of the sampled view and the frame's exposed intensities."""
    value, along_x, along_y, bright = sampled
    gain, bias, inverse_scale = exposure
    x, y, _ = point
    slope_x, slope_y = along_x * focal[0] * inverse_z, along_y * focal[1] * inverse_z
    slope_z = -(slope_x * x + slope_y * y) * inverse_z
    residual = tl.where(bright, value - (gain * own + bias), 0.0)
    root, squares = _weights(residual, inverse_scale, bright)
    J = _pose_columns(columns, (slope_x, slope_y, slope_z), point)
    J += _column(columns, 6, -own) + _column(columns, RESIDUAL, residual)
    J += tl.where(columns == 7, -1.0, 0.0)
    return tl.where(bright[:, None], J * (root * root_weight)[:, None], 0.0), bright, squares


@triton.jit
def accumulate(
    texture,
    surface,
    intensity,
    depth,
    scalars,
    parts,
    model_width,
    model_height,
    frame_width,
    frame_height,
    gate,
    root_weight,
    chunks,
    BLOCK: tl.constexpr,
):
    """Compute one partial sum [16, 16] per program, from every n-th chunk of the frame's pixels.

    `scalars` are in the order above; `root_weight` is the square root of the photometric term's
    weight.
    """
    fx, fy = tl.load(scalars), tl.load(scalars + 1)
    cx, cy = tl.load(scalars + 2), tl.load(scalars + 3)
    frame_fx, frame_fy = tl.load(scalars + 4), tl.load(scalars + 5)
    frame_cx, frame_cy = tl.load(scalars + 6), tl.load(scalars + 7)
    row_x, row_y, row_z = _row(scalars, 0), _row(scalars, 1), _row(scalars, 2)
    gain, bias = tl.load(scalars + EXPOSURE), tl.load(scalars + EXPOSURE + 1)
    inverse_intensity = tl.load(scalars + EXPOSURE + 2)
    inverse_depth = tl.load(scalars + EXPOSURE + 3)
    columns = tl.arange(0, WIDE)[None, :]
    place = tl.arange(0, WIDE)
    total = tl.zeros([WIDE, WIDE], dtype=tl.float32)
    tail = tl.zeros([WIDE], dtype=tl.float32)
    for chunk in range(tl.program_id(0), chunks, tl.num_programs(0)):
        i = chunk * BLOCK + tl.arange(0, BLOCK)
        measured = tl.load(depth + i, mask=i < frame_width * frame_height, other=0.0)
        valid = measured > 0.0
        own = tl.load(intensity + i, mask=valid, other=0.0)
        rx = ((i % frame_width).to(tl.float32) - frame_cx) / frame_fx
        ry = ((i // frame_width).to(tl.float32) - frame_cy) / frame_fy
        x = _coordinate(row_x, measured, rx, ry)
        y = _coordinate(row_y, measured, rx, ry)
        z = _coordinate(row_z, measured, rx, ry)
        valid = valid & (z > NEAR_M)
        inverse_z = 1.0 / tl.where(valid, z, 1.0)
        u, v = fx * x * inverse_z + cx, fy * y * inverse_z + cy
        valid = valid & (u >= 0.0) & (v >= 0.0) & (u < model_width - 1.0) & (v < model_height - 1.0)
        u, v = tl.where(valid, u, 0.0), tl.where(valid, v, 0.0)
        tail += tl.where(place == 4, tl.sum(valid.to(tl.float32), axis=0), 0.0)

        # Geometry: the plane of the nearest model pixel.
        at = (v + 0.5).to(tl.int32) * model_width + (u + 0.5).to(tl.int32)
        seen = tl.load(texture + 4 * at + 3, mask=valid, other=0.0)
        close = valid & (seen > 0.0) & (tl.abs(seen - z) < gate * seen)
        J, flat, squares = _point_to_plane(
            columns, surface, at, close, (x, y, z), seen, inverse_z, inverse_depth
        )
        # Three tensor-core products per float32 product: the normal equations are ill-conditioned.
        total = tl.dot(tl.trans(J), J, total, input_precision="tf32x3")
        tail += _counted(place, 1, flat, squares)

        # Intensity, where all taps lie on one surface.
        sampled = _interpolated(texture, surface, model_width, u, v, close)
        exposure = (gain, bias, inverse_intensity)
        J, bright, squares = _photometric(
            columns, sampled, own, exposure, (x, y, z), (fx, fy), inverse_z, root_weight
        )
        total = tl.dot(tl.trans(J), J, total, input_precision="tf32x3")
        tail += _counted(place, 0, bright, squares)
    rows = tl.arange(0, WIDE)[:, None]
    total = tl.where(rows == TAIL, tail[None, :], total)
    tl.store(parts + tl.program_id(0) * WIDE * WIDE + rows * WIDE + columns, total)
