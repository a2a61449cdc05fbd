"""Instances: masks of single views become persistent objects, and every Gaussian knows its own.

The stage does not touch the optimisation. It sees every keyframe, keeps a model of the objects of
each submap (`tracking`), and lets the keyframes vote for the Gaussians at the end (`voting`).
"""
