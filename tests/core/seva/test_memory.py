"""Memory found without loading anything, against what a real network takes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from cat3d_core.diffusion import SIZES
from cat3d_core.diffusion.memory import multiview_need, peak_bytes, weight_bytes
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.seva.config import TINY, SevaConfig
from cat3d_core.seva.model import seva_need

_MEASURE = """
import torch
from cat3d_core.diffusion.memory import peak_bytes
from cat3d_core.seva.checkpoint import random_seva
from cat3d_core.seva.config import TINY
from cat3d_core.seva.network import SevaUNet

torch.set_num_threads(1)

def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))

def inputs(device, side):
    return [torch.zeros(2, 5, 4, side, side, device=device), torch.zeros(2, device=device),
            torch.zeros(2, 5, 6, side, side, device=device), torch.zeros(2, 5, device=device),
            torch.zeros(2, 1, 24, device=device)]

network = random_seva(TINY)
network(*inputs("cpu", 8))
given = inputs("cpu", 48)
open("/proc/self/clear_refs", "w").write("5")  # the high-water mark starts again
before = kilobytes("VmRSS")
network(*given)
with torch.device("meta"):
    empty = SevaUNet(TINY)
predicted = peak_bytes(lambda: empty(*inputs("meta", 48)))
print(1024 * (kilobytes("VmHWM") - before), predicted)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the process's memory from /proc")
def test_peak_is_what_a_real_network_takes():
    """The process's own high-water mark; its allocator gives large blocks back at once here."""
    large = {"MALLOC_MMAP_THRESHOLD_": "262144", "MALLOC_TRIM_THRESHOLD_": "262144", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE], capture_output=True, text=True, check=True, env=os.environ | large
    )
    measured, predicted = (int(number) for number in done.stdout.split())
    assert predicted == pytest.approx(measured, rel=0.15)


def test_peak_counts_what_lives_at_one_time():
    def compute():
        a = torch.empty(1000, device="meta")
        b = a + 1  # 8000 bytes live
        del a
        c = b.view(10, 100)  # no new storage
        d = torch.empty(500, device="meta")  # 6000
        return c.mul_(2), d

    assert peak_bytes(compute) == 8000


def test_our_models_weights_are_counted_exactly():
    config = SIZES["small"]
    model = MultiViewModel(config)
    assert multiview_need(config, 1).weights == weight_bytes([model])
    one, four = (multiview_need(config, groups) for groups in (1, 4))
    assert one.work < four.work <= 4 * one.work
    half = multiview_need(config, 4, torch.float16)
    assert half.work < 0.6 * four.work
    assert half.total == half.weights + half.work


def test_sevas_need_at_its_size():
    """2.5 GB of 16-bit network, 2.5 of image tower, 0.3 of autoencoder; nothing is allocated."""
    need = seva_need(SevaConfig(), 1)
    assert need.weights == pytest.approx(2.53e9 + 2.53e9 + 0.33e9, rel=0.02)
    assert 3e9 < need.work < 8e9
    tiny = seva_need(TINY, 1, dtype=torch.float32)
    assert tiny.work < need.work
