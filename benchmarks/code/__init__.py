"""The code itself: structure, mutation testing, hashes of results."""
