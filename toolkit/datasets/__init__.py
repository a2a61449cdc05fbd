"""Recordings: where frames, poses and labels lie, and whether they agree with each other.

Knows: formats of data sets and sensors (`readers`), time stamps, units and conventions of poses,
shutters (`shutter`), the checks of `check-data` (`agreement`), and `synthetic_rooms`.
In: a folder or a file. Out: frames, and findings in plain words.
For others: `registry.open_dataset`, `base.Recording`, `options.DatasetOptions`.
"""
