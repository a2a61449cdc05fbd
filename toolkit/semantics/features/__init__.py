"""Global image descriptors for place recognition: one vector per view."""
