"""What leaves a finished run: meshes, point clouds, data sets for other trainers, renders along a path.

`source` opens the run; `mesh`, `dataset`, `path` and `ply` each write one kind of thing.
"""
