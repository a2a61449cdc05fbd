"""Pose graphs: odometry and loops made consistent, and what that moves."""
