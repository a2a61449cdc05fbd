"""Monocular sequences: camera motion and depth from colour images alone."""
