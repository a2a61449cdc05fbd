"""The map: isotropic Gaussians, where they come from and how they go."""

from toolkit.gaussians.cloud import GaussianCloud

__all__ = ["GaussianCloud"]
