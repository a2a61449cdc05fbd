"""Depth where no sensor has measured it.

Knows: `depth_priors` (networks, depth from neighbouring keyframes, its scale and its errors) and
`monocular` (motion and sparse points from images alone, loops with a scale).
In: images, and poses or priors if there are any. Out: frames with depth, trajectories.
For others: `depth_priors.correction`, `depth_priors.factory`, `depth_priors.options`,
`depth_priors.provider`, `monocular.confirmed_depth`, `monocular.given`, `monocular.motion`,
`monocular.options`, `monocular.prior_check`, `monocular.scale`, `monocular.sequence`.
"""
