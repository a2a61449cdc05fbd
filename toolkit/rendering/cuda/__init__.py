"""The renderer in Triton: CUDA GPUs, and any CPU through Triton's interpreter (slowly)."""
