"""Memory layout shared by the alignment kernels: normal equations and state."""

import triton.language as tl

# Columns of the Jacobian: translation, rotation, gain, bias, and the residual; padded to the
# minimum width of a matrix product.
WIDE = tl.constexpr(16)
RESIDUAL = tl.constexpr(8)
PARAMETERS = tl.constexpr(8)

# A partial sum: the product J^T J [16, 16]. Its last row, otherwise 0, holds the numbers of
# intensity and depth residuals, their weighted sums of squares, and the number of frame pixels.
TAIL = tl.constexpr(15)
PART = tl.constexpr(256)

# The state of an alignment, float64.
T_AT = tl.constexpr(0)  # 12: the rows [R | t] of T_view_camera
GAIN = tl.constexpr(12)
BIAS = tl.constexpr(13)
SIGMA_INTENSITY = tl.constexpr(14)
SIGMA_DEPTH = tl.constexpr(15)
STEPS = tl.constexpr(16)  # number of iterations over all levels
PHASE = tl.constexpr(17)  # 0 running, 1 this level has converged, 2 cannot be solved
STATE = 32
