"""Recordings: where frames, poses and labels lie, and whether they agree with each other.

Knows: formats of data sets and sensors (`readers`), time stamps, units and conventions of poses,
shutters (`shutter`), the checks of `check-data` (`agreement`), and `synthetic_rooms`.
In: a folder or a file. Out: frames, and findings in plain words.
For others: `registry`, `base`, `options`, `prefetch`, `resize`, `samples`, `checks`, `findings`,
`agreement.findings`, `faults`, `estimates`, `carrier`, `changed_frames`, `images_only`,
`pose_convention`, `synthetic_rooms`.
"""
