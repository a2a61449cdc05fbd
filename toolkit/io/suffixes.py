"""Suffixes of the files that are written, known without the libraries that write them."""

MESH_SUFFIXES = (".ply",)
POINT_SUFFIXES = (".ply", ".pcd")
LABELLED_SUFFIXES = (".ply", ".las", ".laz")
GLTF_SUFFIXES = (".glb", ".gltf")
USD_SUFFIXES = (".usda", ".usdc", ".usd", ".usdz")
# Scene formats, which can contain splats.
SCENE_SUFFIXES = (*GLTF_SUFFIXES, *USD_SUFFIXES)
# `.compressed.ply` ends in `.ply`.
SPLAT_SUFFIXES = (".ply", ".splat", ".spz", ".sog", *SCENE_SUFFIXES)
