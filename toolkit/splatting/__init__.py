"""Gaussians, their images, and derivatives of both.

Knows: `gaussians` (a cloud of them), `rendering` (images by several backends), `losses`, and
`alignment` (poses from images of the map: pyramids, normal equations, determinacy).
In: Gaussians, a camera, a pose, an image. Out: images, gradients, relative poses.
For others: what `gaussians`, `rendering`, `losses` and `alignment` contain.
"""
