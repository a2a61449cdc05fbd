"""Refinement of the map of a finished run in tasks that share nothing but storage."""
