"""SLAM: prepare each frame, locate the camera, map keyframes, close loops.

Knows: `system` (one frame's way), `tracking` (poses against the map), `mapping` (Gaussians from
keyframes), `submaps`, `loops` (from a candidate to a correction), `refinement`, `pacing` (frames
at camera rate), `listeners` (who is told how the map grows).
In: frames with depth. Out: poses, submaps, loops.
For others: `system.Slam`, `result.SlamResult`, `submaps.submap.Submap`, `loops.closing`,
`refinement`, `pacing.paced.PacedSlam`.
"""
