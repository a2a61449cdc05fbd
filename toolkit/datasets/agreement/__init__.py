"""Whether what is stated about a recording agrees with its images.

- `pairs`: pairs of frames and their relative poses, from depth and colour.
- `intrinsics`: focal length, principal point and lens distortion with which these agree; `lens`:
  the pixels of such a camera.
- `given_poses`: unit of depth, delay and jumps of given poses.
- `labels`: label ids that change their meaning between frames.
- `findings`: what of it contradicts the images, in words.
"""
