"""The renderer and the tracker on a GPU."""
