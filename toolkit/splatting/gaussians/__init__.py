"""The map of isotropic Gaussians: storage, seeding and allocation."""
