"""Kernel: one Gauss-Newton step from its partial sums; see `normal_equations`."""

import triton
import triton.language as tl

from toolkit.alignment.cuda.layout import (
    BIAS,
    GAIN,
    PARAMETERS,
    PART,
    PHASE,
    RESIDUAL,
    SIGMA_DEPTH,
    SIGMA_INTENSITY,
    STEPS,
    T_AT,
    TAIL,
    WIDE,
)


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
def _added(parts, count, rows, columns, ROWS: tl.constexpr):
    """Sum [16, 16] of the partial sums, in order."""
    A = tl.zeros([WIDE, WIDE], dtype=tl.float64)
    for start in range(0, count, ROWS):
        part = start + tl.arange(0, ROWS)[:, None, None]
        at = part * PART + rows[None, :, :] * WIDE + columns[None, :, :]
        A += tl.sum(tl.load(parts + at, mask=part < count, other=0.0).to(tl.float64), axis=0)
    return A


@triton.jit
def _with_prior(A, rows, columns, information, gain_change, bias_change):
    """[H | g] with the prior on the exposure; see `normal_equations.add_exposure_prior`."""
    A += tl.where((rows == columns) & (rows >= 6) & (rows < PARAMETERS), information, 0.0)
    A += tl.where((rows == 6) & (columns == RESIDUAL), information * gain_change, 0.0)
    A += tl.where((rows == 7) & (columns == RESIDUAL), information * bias_change, 0.0)
    return A


@triton.jit
def _without_exposure(A, rows, columns):
    """[H | g] without gain and bias; see `normal_equations.fix_exposure`."""
    exposed = ((rows >= 6) | ((columns >= 6) & (columns < PARAMETERS))) & (rows < PARAMETERS)
    return tl.where(exposed, tl.where(rows == columns, 1.0, 0.0), A)


@triton.jit
def _step(A, rows, columns, place: tl.constexpr):
    """Two consecutive components of the step from the solved equations."""
    first = -_entry(A, rows, columns, place, RESIDUAL)
    return first, -_entry(A, rows, columns, place + 1, RESIDUAL)


@triton.jit
def _move(state, shift, turn, squared, angle):
    """Multiply the pose from the left by the exponential of a step; see `se3.exp`."""
    s0, s1, s2 = shift
    s3, s4, s5 = turn
    tiny = angle < 1e-4
    safe = tl.where(tiny, 1.0, angle)
    p = tl.where(tiny, 1.0 - squared / 6.0, tl.sin(safe) / safe)
    q = tl.where(tiny, 0.5 - squared / 24.0, (1.0 - tl.cos(safe)) / (safe * safe))
    c = tl.where(tiny, 1.0 / 6.0 - squared / 120.0, (safe - tl.sin(safe)) / (safe * safe * safe))
    # exp of the rotation, and the left Jacobian that is applied to the translation's tangent.
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
        at = state + T_AT + k
        a, b, d = tl.load(at), tl.load(at + 4), tl.load(at + 8)
        shifted = 1.0 if k == 3 else 0.0
        tl.store(at, e00 * a + e01 * b + e02 * d + shifted * d0)
        tl.store(at + 4, e10 * a + e11 * b + e12 * d + shifted * d1)
        tl.store(at + 8, e20 * a + e21 * b + e22 * d + shifted * d2)


@triton.jit
def _rescaled(scale, count, squares, least, most):
    """A scale after one fixed-point iteration of Student's t distribution, within bounds."""
    found = scale * tl.sqrt(squares / tl.maximum(count, 1.0))
    return tl.minimum(tl.maximum(found, least), most)


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
    min_pixels,
    small_m,
    small_rad,
    least_intensity,
    most_intensity,
    least_depth,
    most_depth,
    ROWS: tl.constexpr,
    EXPOSURE: tl.constexpr,
):
    """Sum the parts in order, store the sum in `last` [16, 16], and take the step."""
    if tl.load(state + PHASE) > 0.5:
        return
    rows, columns = tl.arange(0, WIDE)[:, None], tl.arange(0, WIDE)[None, :]
    A = _added(parts, count, rows, columns, ROWS)
    tl.store(last + rows * WIDE + columns, A)
    bright, flat = _entry(A, rows, columns, TAIL, 0), _entry(A, rows, columns, TAIL, 1)
    bright_square = _entry(A, rows, columns, TAIL, 2)
    flat_square = _entry(A, rows, columns, TAIL, 3)
    gain, bias = tl.load(state + GAIN), tl.load(state + BIAS)
    sigma_intensity, sigma_depth = tl.load(state + SIGMA_INTENSITY), tl.load(state + SIGMA_DEPTH)
    tl.store(state + STEPS, tl.load(state + STEPS) + 1.0)

    A = tl.where((rows < PARAMETERS) & (columns <= RESIDUAL), A, 0.0)
    if EXPOSURE:
        information = photometric_weight * prior * bright / (sigma_intensity * sigma_intensity)
        A = _with_prior(A, rows, columns, information, gain - last_gain, bias - last_bias)
    else:
        A = _without_exposure(A, rows, columns)
    A = tl.where((rows == columns) & (rows < PARAMETERS), A * (1.0 + 1e-6), A)
    A = _solved(A, rows, columns)
    s0, s1 = _step(A, rows, columns, 0)
    s2, s3 = _step(A, rows, columns, 2)
    s4, s5 = _step(A, rows, columns, 4)
    s6, s7 = _step(A, rows, columns, 6)
    every = s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7
    # An infinity or NaN times 0 is NaN.
    if (bright + flat < min_pixels) | (every * 0.0 != 0.0):
        tl.store(state + PHASE, 2.0)
        return

    squared = s3 * s3 + s4 * s4 + s5 * s5
    angle = tl.sqrt(squared)
    _move(state, (s0, s1, s2), (s3, s4, s5), squared, angle)
    tl.store(state + GAIN, gain + s6)
    tl.store(state + BIAS, bias + s7)
    if bright > 0.0:
        found = _rescaled(sigma_intensity, bright, bright_square, least_intensity, most_intensity)
        tl.store(state + SIGMA_INTENSITY, found)
    if flat > 0.0:
        found = _rescaled(sigma_depth, flat, flat_square, least_depth, most_depth)
        tl.store(state + SIGMA_DEPTH, found)
    moved = tl.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
    if (moved < small_m) & (angle < small_rad):
        tl.store(state + PHASE, 1.0)
