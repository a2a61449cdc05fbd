"""Loop closure: places seen again, found and verified (G-III.C)."""
