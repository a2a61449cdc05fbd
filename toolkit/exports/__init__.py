"""Maps and runs in the formats of other tools.

Knows: layouts of COLMAP and nerfstudio, meshes with labels, occupancy grids, scene graphs, point
clouds, floor plans.
In: a finished run or a map with labels. Out: files.
For others: `selection`, `options`, and one module per format: `floors`, `map_changes`,
`mapped_scene`, `plans`, `scene_graph`, `surfaces`, `views`.
"""
