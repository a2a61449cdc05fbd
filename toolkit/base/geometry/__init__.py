"""Rigid motions, cameras, trajectories, frusta and point clouds."""
