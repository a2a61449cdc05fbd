"""Depth of images that were recorded without it."""
