"""semsplat: semantic 3D Gaussian Splatting SLAM."""

__version__ = "0.1.0"
