"""Recordings as people have them: kinds, checks, damaged and hostile files."""
