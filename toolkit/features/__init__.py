"""Image descriptors: one vector a view, by which places are recognised."""
