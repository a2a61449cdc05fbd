"""Global refinement after the last frame: optimisation of submaps and fusion into one map."""
