"""Depth where no sensor has measured it.

Knows: `depth_priors` (networks, depth from neighbouring keyframes, its scale and its errors) and
`monocular` (motion and sparse points from images alone, loops with a scale).
In: images, and poses or priors if there are any. Out: frames with depth, trajectories.
For others: `depth_priors` for mapping; `monocular` makes recordings without depth into ones with.
"""
