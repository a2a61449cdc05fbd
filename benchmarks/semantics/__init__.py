"""Labels, class trees, objects, and their relations."""
