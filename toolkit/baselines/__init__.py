"""Baselines: methods of the papers and of Open3D, implemented for comparison with ours.

They have the same inputs and outputs as the stages that they replace:

- `first_order_tracker`: the tracker of Hier-SLAM and GauSem, Adam on the camera pose;
- `first_order_fine`: the fine registration of GauSem, Adam on the pose of the submap (G-6);
- `two_way`: LoopSplat's registration in both directions, view by view;
- `clouds`: Open3D's global registration (FPFH) and ICP on the Gaussians' centres.

`factory` builds the method selected by the options, ours or a baseline.
"""
