"""SLAM: prepare each frame, locate the camera, map keyframes, close loops.

Knows: `system` (one frame's way), `tracking` (poses against the map), `mapping` (Gaussians from
keyframes), `submaps`, `loops` (from a candidate to a correction), `refinement`, `pacing` (frames
at camera rate), `listeners` (who is told how the map grows).
In: frames with depth. Out: poses, submaps, loops.
For others: `system`, `result`, `listeners`, `front_end`, `frame_preparation`, `ignored_frames`,
`length_unit`, `submaps`, `refinement.fusion`, `pacing`, `tracking`, `mapping`, `loops.closing`,
`loops.correction`, `loops.log`, `loops.registration`, `loops.splat_maps`, `loops.two_maps`,
`loops.verification`.
"""
