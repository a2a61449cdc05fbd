"""What happens once all frames are in: refinement of submaps, and fusion into one map."""
