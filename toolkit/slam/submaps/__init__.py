"""Submaps: parts of the map of bounded size, each with its own coordinate frame."""
