"""The code itself: mutation testing, hashes of results."""
