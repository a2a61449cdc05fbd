"""Generation of a taxonomy from a list of class names (H-III.A.2)."""
