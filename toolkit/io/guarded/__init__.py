"""Readers of files that may be damaged or hostile: size, depth and kind are checked before reading.

Each raises `DamagedError`, a `ValueError`, for whatever is wrong with the content.
"""
