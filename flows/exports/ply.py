"""PLY files: binary little-endian points with normals and colours, and faces where there are any."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from schemas.documents import write_bytes

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
                  ("red", "u1"), ("green", "u1"), ("blue", "u1")])  # fmt: skip
FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
PLY_TYPE = {"f4": "float", "u1": "uchar"}


def write_ply(
    path: Path, points: np.ndarray, normals: np.ndarray, colours: np.ndarray, faces: np.ndarray | None = None
) -> None:
    """Write points (P, 3), unit normals (P, 3), sRGB colours (P, 3) uint8, triangles (F, 3), at once or not at all."""
    rows = np.empty(len(points), POINT)
    for names, values in (("xyz", points), (("nx", "ny", "nz"), normals), (("red", "green", "blue"), colours)):
        for axis, name in enumerate(names):
            rows[name] = values[:, axis]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {PLY_TYPE[POINT[name].str[1:]]} {name}" for name in POINT.names or ()]
    body = rows.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), FACE)
        triangles["count"], triangles["vertex_indices"] = 3, faces
        body += triangles.tobytes()
    write_bytes(path, "\n".join([*header, "end_header\n"]).encode("ascii") + body)
