"""Synthetic images of places."""

from __future__ import annotations

import numpy as np
import torch


def place(seed: int, height: int = 60, width: int = 100) -> torch.Tensor:
    """An image [3, H, W] of coloured boxes, wider than a view so that views can be shifted."""
    generator = np.random.default_rng(seed)
    picture = np.full((height, width, 3), generator.uniform(0.3, 0.7, 3))
    for _ in range(14):
        y, x = generator.integers(0, height - 8), generator.integers(0, width - 8)
        h, w = generator.integers(6, height // 2), generator.integers(6, width // 3)
        picture[y : y + h, x : x + w] = generator.uniform(0.1, 0.9, 3)
    return torch.tensor(picture, dtype=torch.float32).permute(2, 0, 1)
