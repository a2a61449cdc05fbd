"""Triton renderer for CUDA GPUs; runs slowly on any CPU with Triton's interpreter."""
