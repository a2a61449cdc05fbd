"""Rolling shutter of a recording: its readout time, and the delay between depth and colour.

The rows of an image are exposed one after another. In frames that were taken with different
velocities, the same surface is therefore bent differently. Frames of short windows of a recording
are aligned, which gives their velocities; then the pose, the readout time and the delay are
estimated from pairs of frames with different velocities.
"""
