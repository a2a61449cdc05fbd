"""Dense alignment of RGB-D images: pyramids, linearisation, Gauss-Newton, image matching.

A frame is aligned to a model: a rendered view of the map, or the images of a keyframe. The
residuals are photometric and point-to-plane. `data` defines the data types of the other modules,
`backend` selects the implementation (C++, NumPy, or torch and Triton).
"""
