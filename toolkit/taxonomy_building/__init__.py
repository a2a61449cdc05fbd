"""How a taxonomy is made from a list of class names (H-III.A.2)."""
