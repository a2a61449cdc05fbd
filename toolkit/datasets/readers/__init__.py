"""Readers of data sets, sensors and folders: one module per format."""
