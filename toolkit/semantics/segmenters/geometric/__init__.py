"""A segmenter that needs neither labels nor weights: what a room is made of, from its depth."""

from toolkit.semantics.segmenters.geometric.segmenter import CLASS_NAMES, GeometricSegmenter

__all__ = ["CLASS_NAMES", "GeometricSegmenter"]
