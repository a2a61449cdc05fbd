"""Closed, typed settings; imports no stage."""
