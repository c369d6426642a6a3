"""Blocks of `cpu_threads` may lie in each other and end in any order."""

from __future__ import annotations

import contextlib

import torch

from flows.jobs.device import cpu_threads


def test_blocks_in_each_other() -> None:
    before = torch.get_num_threads()
    with cpu_threads(2):
        with cpu_threads(1):
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    assert torch.get_num_threads() == before


def test_blocks_of_several_threads_that_end_out_of_order() -> None:
    before = torch.get_num_threads()
    first, second = contextlib.ExitStack(), contextlib.ExitStack()
    first.enter_context(cpu_threads(1))
    second.enter_context(cpu_threads(2))
    first.close()
    assert torch.get_num_threads() == 2
    second.close()
    assert torch.get_num_threads() == before
