"""Trajectories and maps: sequences, hard motion, covariances, Open3D."""
