"""The map: isotropic Gaussians, where they come from and how they go."""
