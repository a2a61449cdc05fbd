"""Files: arrays, images, meshes and splats of all formats, and their guarded readers.

Knows: bytes and limits (`guarded`), files that replace others at once (`atomic`), storage behind a
URL, one module per format.
In: paths and arrays. Out: arrays and paths. It knows no frame, no map and no run.
For others: everything but names with an underscore.
"""
