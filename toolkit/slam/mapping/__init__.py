"""Extends and optimises a submap: keyframes, seeding, pruning, free space, colours and classes."""
