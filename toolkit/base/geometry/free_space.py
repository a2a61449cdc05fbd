"""Free space: how far in front of a measured surface space counts as empty."""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

# The margin in front of the measured depth is the larger of these: in metres, and as a fraction of
# the depth.
FREE_SPACE_M = 0.05
FREE_SPACE = 0.03


@overload
def free_space_margin_m(depth_m: Tensor) -> Tensor: ...
@overload
def free_space_margin_m(depth_m: NDArray[np.float32]) -> NDArray[np.float32]: ...
def free_space_margin_m(depth_m: Tensor | NDArray[np.float32]) -> Tensor | NDArray[np.float32]:
    """Distance [...] in front of measured depths [...] beyond which space is empty, in metres."""
    if isinstance(depth_m, Tensor):
        return (FREE_SPACE * depth_m).clamp_(min=FREE_SPACE_M)
    return np.maximum(FREE_SPACE_M, FREE_SPACE * depth_m)
