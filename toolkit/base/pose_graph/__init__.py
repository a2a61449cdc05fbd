"""Pose graphs: consistency of loops, optimisation and correction of poses."""
