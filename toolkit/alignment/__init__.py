"""Dense alignment of RGB-D images: pyramids, linearisation, Gauss-Newton, image matching.

A frame is aligned to a model: a rendered view of the map, or the images of a keyframe. The
residuals are photometric and point-to-plane. `data` holds the values that pass between the
modules, `backend` selects what computes them (C++, numpy, or torch and Triton).
"""
