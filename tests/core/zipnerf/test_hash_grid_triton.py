"""The Triton kernel against the float64 reference, through Triton's interpreter where there is no GPU."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed.")


def compare(device: str) -> None:
    """Forward, backward in both modes, on dense and hashed levels, against float64; and determinism."""
    from cat3d_core.zipnerf import hash_grid_triton
    from cat3d_core.zipnerf.grid_layout import make_layout
    from cat3d_core.zipnerf.grid_reference import query_reference

    for features, samples in ((1, 6), (4, 3)):
        layout = make_layout(16, 64, 12, features)
        generator = torch.Generator().manual_seed(0)
        positions = (torch.rand((203, samples, 3), generator=generator) * 1.04 - 0.02).to(device)
        std = (10 ** (torch.rand((203, samples), generator=generator) * 5 - 5)).to(device)
        table = torch.randn((layout.rows, features), generator=generator).to(device)
        exact = table.double().requires_grad_()
        expected = query_reference(exact, positions.double(), std.double(), layout)
        gradient = 1e-4 * torch.randn(expected.shape, generator=generator).to(device)
        expected.backward(gradient.double())
        fixed = []
        for deterministic in (False, True, True):
            torch.use_deterministic_algorithms(deterministic)
            leaf = table.clone().requires_grad_()
            got = hash_grid_triton.query(leaf, positions, std, layout)
            got.backward(gradient)
            torch.testing.assert_close(got.double(), expected, rtol=0, atol=3e-6)
            torch.testing.assert_close(got[..., -1].double(), expected[..., -1], rtol=0, atol=1e-6)
            torch.testing.assert_close(leaf.grad.double(), exact.grad, rtol=1e-5, atol=1e-9)
            if deterministic:
                fixed.append(leaf.grad)
        assert torch.equal(fixed[0], fixed[1])
        leaf = table.clone().requires_grad_()
        hash_grid_triton.query(leaf, positions, std, layout).backward(gradient * torch.inf)
        assert not torch.isfinite(leaf.grad).all()  # the step gets skipped, nothing is repaired
    torch.use_deterministic_algorithms(False)


@needs_triton
def test_interpreted_kernel_matches_float64() -> None:
    """In a process of its own: TRITON_INTERPRET has to be set before Triton is imported."""
    root = Path(__file__).resolve().parents[3]
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    subprocess.run([sys.executable, __file__], check=True, env=environment, cwd=root)


@needs_triton
@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="There is no CUDA device here.")
def test_compiled_kernel_matches_float64() -> None:
    compare("cuda")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
    compare("cpu")
