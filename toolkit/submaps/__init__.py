"""Submaps: pieces of bounded size, each in a frame of its own."""
