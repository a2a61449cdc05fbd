"""Trajectories and maps: sequences, hard motion, covariances, presets, Open3D."""
