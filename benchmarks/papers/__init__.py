"""Counterparts of the papers' tables."""
