"""Dense alignment on a GPU: all steps of a frame without asking the host."""
