"""Measures a finished run: poses, images, depth, classes, times, and the report about them."""
