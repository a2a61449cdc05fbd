"""Runs without depth: motion, maps, depth from images."""
