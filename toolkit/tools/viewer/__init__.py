"""Interactive views of maps: an offline page and a local server."""
