"""Loop closure: detection and verification of revisited places (G-III.C)."""
