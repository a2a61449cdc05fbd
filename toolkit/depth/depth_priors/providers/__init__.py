"""Sources of depth priors: files and models."""
