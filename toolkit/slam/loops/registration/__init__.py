"""Registration of submaps: pose of a source submap in the frame of a target (G-III.B)."""
