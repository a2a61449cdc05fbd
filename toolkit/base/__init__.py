"""What every room uses: poses, cameras, frames, options, errors, kernels, pose graphs.

Knows: `geometry`, `pose_graph` (edges, solver, consistency), `frame` and `keyframe`, `exposure`,
`options` (how a stage declares its settings), `errors`, `native` (C++ kernels), `threads`.
In and out: small values without behaviour of their own.
For others: everything but names with an underscore.
"""
