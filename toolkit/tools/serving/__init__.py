"""HTTP service for a finished run: poses, rendered views, queries and objects."""
