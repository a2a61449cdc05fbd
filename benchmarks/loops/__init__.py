"""Loops and submaps: a ring of rooms, detection of loops, registration."""
