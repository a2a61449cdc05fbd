"""Recordings of a run's progress, for viewers."""
