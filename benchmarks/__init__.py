"""Benchmarks of the toolkit by subject; README.md lists them."""
