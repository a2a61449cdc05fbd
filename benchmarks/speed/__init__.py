"""Time: kernels, frames beside an earlier commit, cameras, interrupted and distributed runs."""
