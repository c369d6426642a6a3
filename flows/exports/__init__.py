"""What leaves a run: meshes, point clouds, splats, data sets for other trainers, renders along a path, plans.

`source` opens a finished run and `plan` one with a plan; `mesh`, `dataset`, `path`, `ply` and `splats` (with
`splat_files` and `preview`) each write one kind of thing.
"""
