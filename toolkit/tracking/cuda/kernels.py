"""Kernels: the sums of one Gauss-Newton step, and the step itself.

The equations are those of `alignment_numpy`; the exposure's prior is that of `exposure`.
"""

import triton
import triton.language as tl

from toolkit.tracking.alignment_numpy import EDGE as _EDGE
from toolkit.tracking.alignment_numpy import NEAR_M as _NEAR_M
from toolkit.tracking.alignment_numpy import NU as _NU

NU = tl.constexpr(_NU)
EDGE = tl.constexpr(_EDGE)
NEAR_M = tl.constexpr(_NEAR_M)

# Columns of the Jacobian: translation, rotation, gain, bias, and the residual; padded to the
# least width of a matrix product.
WIDE = tl.constexpr(16)
RESIDUAL = tl.constexpr(8)
PARAMETERS = tl.constexpr(8)

# A partial result: the product [16, 16], and in its last row, which a product leaves 0, the
# numbers of intensity and depth residuals, their weighted squares, and the frame's pixels.
TAIL = tl.constexpr(15)
PART = tl.constexpr(256)

# The state of an alignment, float64.
T_AT = tl.constexpr(0)  # 12: the rows [R | t] of T_view_camera
GAIN = tl.constexpr(12)
BIAS = tl.constexpr(13)
SIGMA_INTENSITY = tl.constexpr(14)
SIGMA_DEPTH = tl.constexpr(15)
STEPS = tl.constexpr(16)  # taken, over all levels
PHASE = tl.constexpr(17)  # 0 at work, 1 this level has converged, 2 it cannot be solved
STATE = 32


@triton.jit
def _column(columns, place: tl.constexpr, values):
    """Values [pixels] in one column of a matrix [pixels, 16]."""
    return tl.where(columns == place, values[:, None], 0.0)


@triton.jit
def _pose_columns(columns, nx, ny, nz, x, y, z):
    """Derivative of n . Y by a motion that multiplies from the left, in columns 0 to 5."""
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
def accumulate(
    texture,
    surface,
    intensity,
    depth,
    camera,
    state,
    parts,
    width,
    height,
    gate,
    chunks,
    BLOCK: tl.constexpr,
):
    """One partial result [16, 16] a program, of every so many chunks of the frame's pixels."""
    if tl.load(state + PHASE) > 0.5:
        return
    fx, fy = tl.load(camera), tl.load(camera + 1)
    cx, cy = tl.load(camera + 2), tl.load(camera + 3)
    t00, t01 = tl.load(state).to(tl.float32), tl.load(state + 1).to(tl.float32)
    t02, t03 = tl.load(state + 2).to(tl.float32), tl.load(state + 3).to(tl.float32)
    t10, t11 = tl.load(state + 4).to(tl.float32), tl.load(state + 5).to(tl.float32)
    t12, t13 = tl.load(state + 6).to(tl.float32), tl.load(state + 7).to(tl.float32)
    t20, t21 = tl.load(state + 8).to(tl.float32), tl.load(state + 9).to(tl.float32)
    t22, t23 = tl.load(state + 10).to(tl.float32), tl.load(state + 11).to(tl.float32)
    gain, bias = tl.load(state + GAIN).to(tl.float32), tl.load(state + BIAS).to(tl.float32)
    inverse_intensity = (1.0 / tl.load(state + SIGMA_INTENSITY)).to(tl.float32)
    inverse_depth = (1.0 / tl.load(state + SIGMA_DEPTH)).to(tl.float32)
    columns = tl.arange(0, WIDE)[None, :]
    total = tl.zeros([WIDE, WIDE], dtype=tl.float32)
    tail = tl.zeros([WIDE], dtype=tl.float32)
    place = tl.arange(0, WIDE)
    # The tensor cores' three products a float32 product: the normal equations are stiff.
    for chunk in range(tl.program_id(0), chunks, tl.num_programs(0)):
        i = chunk * BLOCK + tl.arange(0, BLOCK)
        measured = tl.load(depth + i, mask=i < width * height, other=0.0)
        valid = measured > 0.0
        own = tl.load(intensity + i, mask=valid, other=0.0)
        rx = ((i % width).to(tl.float32) - cx) / fx
        ry = ((i // width).to(tl.float32) - cy) / fy
        x = measured * (t00 * rx + t01 * ry + t02) + t03
        y = measured * (t10 * rx + t11 * ry + t12) + t13
        z = measured * (t20 * rx + t21 * ry + t22) + t23
        valid = valid & (z > NEAR_M)
        inverse_z = 1.0 / tl.where(valid, z, 1.0)
        u, v = fx * x * inverse_z + cx, fy * y * inverse_z + cy
        valid = valid & (u >= 0.0) & (v >= 0.0) & (u < width - 1.0) & (v < height - 1.0)
        u, v = tl.where(valid, u, 0.0), tl.where(valid, v, 0.0)
        tail += tl.where(place == 4, tl.sum(valid.to(tl.float32), axis=0), 0.0)

        # Geometry: the plane of the nearest model pixel.
        at = (v + 0.5).to(tl.int32) * width + (u + 0.5).to(tl.int32)
        seen = tl.load(texture + 4 * at + 3, mask=valid, other=0.0)
        close = valid & (seen > 0.0) & (tl.abs(seen - z) < gate * z)
        nx = tl.load(surface + 4 * at, mask=close, other=0.0)
        ny = tl.load(surface + 4 * at + 1, mask=close, other=0.0)
        nz = tl.load(surface + 4 * at + 2, mask=close, other=0.0)
        offset = tl.load(surface + 4 * at + 3, mask=close, other=0.0)
        flat = close & ((nx != 0.0) | (ny != 0.0) | (nz != 0.0))
        residual = tl.where(flat, nx * x + ny * y + nz * z - offset, 0.0)
        # The sensor's noise grows with the square of the depth.
        scale = inverse_depth / tl.maximum(measured * measured, 0.25)
        square = residual * scale * residual * scale
        robust = tl.where(flat, 1.0 / (square + NU) * (NU + 1.0), 0.0)
        root = tl.sqrt(robust) * scale
        J = _pose_columns(columns, nx, ny, nz, x, y, z) + _column(columns, RESIDUAL, residual)
        J = tl.where(flat[:, None], J * root[:, None], 0.0)
        total = tl.dot(tl.trans(J), J, total, input_precision="tf32x3")
        tail += tl.where(place == 1, tl.sum(flat.to(tl.float32), axis=0), 0.0)
        tail += tl.where(place == 3, tl.sum(robust * square, axis=0), 0.0)

        # Intensity, where all taps lie on one surface.
        left, top = u.to(tl.int32), v.to(tl.int32)
        a, b = u - left.to(tl.float32), v - top.to(tl.float32)
        at = top * width + left
        i00, x00, y00, d00 = _tap(texture, at, close)
        i01, x01, y01, d01 = _tap(texture, at + 1, close)
        i10, x10, y10, d10 = _tap(texture, at + width, close)
        i11, x11, y11, d11 = _tap(texture, at + width + 1, close)
        nearest = tl.minimum(tl.minimum(d00, d01), tl.minimum(d10, d11))
        farthest = tl.maximum(tl.maximum(d00, d01), tl.maximum(d10, d11))
        bright = close & (nearest > 0.0) & (farthest - nearest <= nearest * EDGE)
        w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
        value = w00 * i00 + w01 * i01 + w10 * i10 + w11 * i11
        slope_x = (w00 * x00 + w01 * x01 + w10 * x10 + w11 * x11) * fx * inverse_z
        slope_y = (w00 * y00 + w01 * y01 + w10 * y10 + w11 * y11) * fy * inverse_z
        slope_z = -(slope_x * x + slope_y * y) * inverse_z
        residual = tl.where(bright, value - (gain * own + bias), 0.0)
        square = residual * inverse_intensity * residual * inverse_intensity
        robust = tl.where(bright, 1.0 / (square + NU) * (NU + 1.0), 0.0)
        root = tl.sqrt(robust) * inverse_intensity
        J = _pose_columns(columns, slope_x, slope_y, slope_z, x, y, z)
        J += _column(columns, 6, -own) + _column(columns, RESIDUAL, residual)
        J += tl.where(columns == 7, -1.0, 0.0)
        J = tl.where(bright[:, None], J * root[:, None], 0.0)
        total = tl.dot(tl.trans(J), J, total, input_precision="tf32x3")
        tail += tl.where(place == 0, tl.sum(bright.to(tl.float32), axis=0), 0.0)
        tail += tl.where(place == 2, tl.sum(robust * square, axis=0), 0.0)
    rows = tl.arange(0, WIDE)[:, None]
    total = tl.where(rows == TAIL, tail[None, :], total)
    tl.store(parts + tl.program_id(0) * PART + rows * WIDE + columns, total)


@triton.jit
def _entry(matrix, rows, columns, row: tl.constexpr, column: tl.constexpr):
    return tl.sum(tl.sum(tl.where((rows == row) & (columns == column), matrix, 0.0), 1), 0)


@triton.jit
def _solved(A, rows, columns):
    """Gauss-Jordan on [H | g]: the last column then holds the solution of H x = g."""
    for k in tl.static_range(PARAMETERS):
        pivot = _entry(A, rows, columns, k, k)
        row = tl.sum(tl.where(rows == k, A, 0.0), axis=0) / pivot
        factor = tl.sum(tl.where(columns == k, A, 0.0), axis=1)
        A = tl.where(rows == k, row[None, :], A - factor[:, None] * row[None, :])
    return A


@triton.jit
def advance(
    parts,
    state,
    last,
    count,
    last_gain,
    last_bias,
    photometric_weight,
    prior,
    fewest,
    small_m,
    small_rad,
    least_intensity,
    most_intensity,
    least_depth,
    most_depth,
    ROWS: tl.constexpr,
    EXPOSURE: tl.constexpr,
):
    """Add the parts up in their order, keep them in `last` [16, 16], and take the step."""
    if tl.load(state + PHASE) > 0.5:
        return
    rows, columns = tl.arange(0, WIDE)[:, None], tl.arange(0, WIDE)[None, :]
    A = tl.zeros([WIDE, WIDE], dtype=tl.float64)
    for start in range(0, count, ROWS):
        part = start + tl.arange(0, ROWS)[:, None, None]
        at = part * PART + rows[None, :, :] * WIDE + columns[None, :, :]
        A += tl.sum(tl.load(parts + at, mask=part < count, other=0.0).to(tl.float64), axis=0)
    tl.store(last + rows * WIDE + columns, A)
    bright, flat = _entry(A, rows, columns, TAIL, 0), _entry(A, rows, columns, TAIL, 1)
    bright_square = _entry(A, rows, columns, TAIL, 2)
    flat_square = _entry(A, rows, columns, TAIL, 3)
    gain, bias = tl.load(state + GAIN), tl.load(state + BIAS)
    sigma_intensity, sigma_depth = tl.load(state + SIGMA_INTENSITY), tl.load(state + SIGMA_DEPTH)
    tl.store(state + STEPS, tl.load(state + STEPS) + 1.0)

    A = tl.where((rows < PARAMETERS) & (columns <= RESIDUAL), A, 0.0)
    if EXPOSURE:
        # The scale without the photometric weight, which the state carries.
        unweighted = sigma_intensity * sigma_intensity * photometric_weight
        held = prior * bright / unweighted
        A += tl.where((rows == columns) & (rows >= 6) & (rows < PARAMETERS), held, 0.0)
        A += tl.where((rows == 6) & (columns == RESIDUAL), held * (gain - last_gain), 0.0)
        A += tl.where((rows == 7) & (columns == RESIDUAL), held * (bias - last_bias), 0.0)
    else:
        exposed = ((rows >= 6) | ((columns >= 6) & (columns < PARAMETERS))) & (rows < PARAMETERS)
        A = tl.where(exposed, tl.where(rows == columns, 1.0, 0.0), A)
    A = tl.where((rows == columns) & (rows < PARAMETERS), A * (1.0 + 1e-6), A)
    A = _solved(A, rows, columns)
    s0, s1 = -_entry(A, rows, columns, 0, RESIDUAL), -_entry(A, rows, columns, 1, RESIDUAL)
    s2, s3 = -_entry(A, rows, columns, 2, RESIDUAL), -_entry(A, rows, columns, 3, RESIDUAL)
    s4, s5 = -_entry(A, rows, columns, 4, RESIDUAL), -_entry(A, rows, columns, 5, RESIDUAL)
    s6, s7 = -_entry(A, rows, columns, 6, RESIDUAL), -_entry(A, rows, columns, 7, RESIDUAL)
    every = s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7
    # Infinities and NaN alike differ from themselves once multiplied by 0.
    if (bright + flat < fewest) | (every * 0.0 != 0.0):
        tl.store(state + PHASE, 2.0)
        return

    squared = s3 * s3 + s4 * s4 + s5 * s5
    angle = tl.sqrt(squared)
    tiny = angle < 1e-4
    safe = tl.where(tiny, 1.0, angle)
    p = tl.where(tiny, 1.0 - squared / 6.0, tl.sin(safe) / safe)
    q = tl.where(tiny, 0.5 - squared / 24.0, (1.0 - tl.cos(safe)) / (safe * safe))
    c = tl.where(tiny, 1.0 / 6.0 - squared / 120.0, (safe - tl.sin(safe)) / (safe * safe * safe))
    # exp of the rotation, and the left Jacobian that turns the translation's tangent.
    e00, e01, e02 = 1.0 - q * (s4 * s4 + s5 * s5), q * s3 * s4 - p * s5, q * s3 * s5 + p * s4
    e10, e11, e12 = q * s3 * s4 + p * s5, 1.0 - q * (s3 * s3 + s5 * s5), q * s4 * s5 - p * s3
    e20, e21, e22 = q * s3 * s5 - p * s4, q * s4 * s5 + p * s3, 1.0 - q * (s3 * s3 + s4 * s4)
    dot = c * (s3 * s0 + s4 * s1 + s5 * s2)
    m = 1.0 - c * squared
    d0 = m * s0 + q * (s4 * s2 - s5 * s1) + dot * s3
    d1 = m * s1 + q * (s5 * s0 - s3 * s2) + dot * s4
    d2 = m * s2 + q * (s3 * s1 - s4 * s0) + dot * s5
    # The four columns of T_view_camera, one of which is its translation.
    for k in tl.static_range(4):
        a, b, d = tl.load(state + k), tl.load(state + 4 + k), tl.load(state + 8 + k)
        shift = 1.0 if k == 3 else 0.0
        tl.store(state + k, e00 * a + e01 * b + e02 * d + shift * d0)
        tl.store(state + 4 + k, e10 * a + e11 * b + e12 * d + shift * d1)
        tl.store(state + 8 + k, e20 * a + e21 * b + e22 * d + shift * d2)
    tl.store(state + GAIN, gain + s6)
    tl.store(state + BIAS, bias + s7)

    # Student's t: one step of the fixed point of its scales.
    if bright > 0.0:
        found = sigma_intensity * tl.sqrt(bright_square / tl.maximum(bright, 1.0))
        weight = tl.sqrt(photometric_weight + bright * 0.0)
        found = tl.minimum(tl.maximum(found, least_intensity), most_intensity)
        tl.store(state + SIGMA_INTENSITY, found / weight)
    if flat > 0.0:
        found = sigma_depth * tl.sqrt(flat_square / tl.maximum(flat, 1.0))
        tl.store(state + SIGMA_DEPTH, tl.minimum(tl.maximum(found, least_depth), most_depth))
    moved = tl.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
    if (moved < small_m) & (angle < small_rad):
        tl.store(state + PHASE, 1.0)
