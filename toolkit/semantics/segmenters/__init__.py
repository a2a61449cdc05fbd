"""Segmenters: sources of labels."""
