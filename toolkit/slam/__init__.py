"""The SLAM system: prepare each frame, locate the camera, map keyframes, close loops."""
