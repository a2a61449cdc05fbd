"""Registration of submaps: where a source submap lies in a target's frame (G-III.B)."""
