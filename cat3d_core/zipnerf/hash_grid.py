"""The query of a multi-resolution hash grid (Zip-NeRF), by the fastest kernel there is."""

from __future__ import annotations

import torch
from torch import Tensor

from cat3d_core.zipnerf import hash_grid_cpu
from cat3d_core.zipnerf.grid_layout import GridLayout
from cat3d_core.zipnerf.grid_reference import query_reference


def query(table: Tensor, positions: Tensor, std: Tensor, layout: GridLayout) -> Tensor:
    """`query_reference` by the fastest kernel there is for the tensors' device and dtype; gradient for the table only.

    float32 on the CPU: the C++ kernel where a compiler is found; float32 on CUDA: Triton where it is installed.
    Otherwise the reference. All CPU paths are deterministic.
    """
    if table.dtype == torch.float32:
        if table.device.type == "cpu":
            if hash_grid_cpu.available():
                return hash_grid_cpu.query(table, positions, std, layout)
        elif table.device.type == "cuda":
            from cat3d_core.zipnerf import hash_grid_triton  # only a GPU pays for the import of Triton

            if hash_grid_triton.available():
                return hash_grid_triton.query(table, positions, std, layout)
    return query_reference(table, positions, std, layout)
