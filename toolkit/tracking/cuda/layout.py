"""What the alignment's kernels share: the layout of their equations, and of their state."""

import triton.language as tl

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
