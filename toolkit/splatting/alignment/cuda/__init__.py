"""Dense alignment on a GPU: images in torch, normal equations and steps in Triton."""
