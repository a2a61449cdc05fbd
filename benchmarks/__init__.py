"""Benchmarks of the toolkit: run each with `python -m benchmarks.NAME` from the repository root."""
