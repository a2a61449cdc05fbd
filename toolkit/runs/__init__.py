"""Runs: from settings and a recording to a folder with trajectory, map and figures.

Knows: the run folder and its versions, checkpoints, resuming, reports; `maps` of finished runs,
`evaluation` (metrics), `live` (cameras), `batch` (many runs, Ray).
In: settings, a dataset or a camera. Out: a run folder, or what is read from one.
For others: `building`, `execution`, `settings`, `folder`, `new_folder`, `lock`, `stopping`,
`observers`, `progress`, `snapshots`, `scoring`, `highlights`, `image_side`, and what `maps`,
`evaluation`, `live` and `batch` contain.
"""
