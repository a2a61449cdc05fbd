"""Time: kernels, frames beside an earlier commit, cameras."""
