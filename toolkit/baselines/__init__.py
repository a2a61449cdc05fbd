"""Baselines: methods of the papers and of Open3D, implemented for comparison with ours.

They take the same inputs and give the same results as the stages that they stand in for:

- `first_order_tracker`: the tracker of Hier-SLAM and GauSem, Adam on the camera's pose;
- `first_order_fine`: the fine registration of GauSem, Adam on the submap's motion (G-6);
- `two_way`: LoopSplat's registration in both directions, view by view;
- `clouds`: Open3D's global registration (FPFH) and ICP on the Gaussians' centres.

`factory` builds the method that the settings name, ours or a baseline.
"""
