"""Runs without depth: motion, depth from images, tracking on depth priors."""
