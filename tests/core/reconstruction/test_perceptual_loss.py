"""When a reconstruction is trained with a perceptual loss, and what is said when it is not."""

from __future__ import annotations

import types

import pytest

from cat3d_core.reconstruction import perceptual


def test_a_network_is_looked_for_where_the_loss_counts_and_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    network = types.SimpleNamespace(architecture=types.SimpleNamespace(smallest=16), name="a network")
    monkeypatch.setattr(perceptual, "find_perceptual", lambda: network)
    assert perceptual.perceptual_loss(0.0, 32) == (None, [])
    assert perceptual.perceptual_loss(0.1, 16) == (network, [])
    found, decisions = perceptual.perceptual_loss(1.0, 15)
    assert found is None
    assert [decision.kind for decision in decisions] == ["warning"]
    monkeypatch.setattr(perceptual, "find_perceptual", lambda: None)
    found, decisions = perceptual.perceptual_loss(1.0, 32)
    assert found is None
    assert [decision.kind for decision in decisions] == ["warning"]
