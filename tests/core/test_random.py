"""Seeds from keys: what is stored under them must be drawn again alike by later versions."""

from __future__ import annotations

import hashlib

import torch

from cat3d_core.random import derive_seed, generator, normal


def test_seeds_are_the_first_63_bits_of_the_keys_digest() -> None:
    digest = hashlib.sha256(b"7\x1fstr:scene\x1fint:3").digest()
    assert derive_seed(7, "scene", 3) == int.from_bytes(digest, "big") >> (256 - 63)
    assert derive_seed(7, "scene", 3) != derive_seed(7, "scene", "3")
    assert derive_seed(7, "ab", "c") != derive_seed(7, "a", "bc")


def test_numbers_depend_on_the_key_alone() -> None:
    torch.manual_seed(5)
    one = normal((3, 4), 7, "noise", 1)
    torch.manual_seed(6)
    assert torch.equal(normal((3, 4), 7, "noise", 1), one)
    assert torch.equal(torch.randn(3, 4, generator=generator(7, "noise", 1)), one)
    assert one.dtype == torch.float32
