"""Finds the pose of each frame in the map, says how sure it is, and prepares depth for that."""
