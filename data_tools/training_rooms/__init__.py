"""Rooms of many kinds from which the indoor segmenter learns: shapes, arrangements, sensors."""
