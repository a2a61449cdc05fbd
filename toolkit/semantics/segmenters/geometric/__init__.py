"""Segmentation of room structure from depth alone, without labels or learned weights."""

from toolkit.semantics.segmenters.geometric.segmenter import CLASS_NAMES, GeometricSegmenter

__all__ = ["CLASS_NAMES", "GeometricSegmenter"]
