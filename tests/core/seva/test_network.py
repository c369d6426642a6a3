"""SEVA's network: agreement with the original's numbers and our own, and what it must not depend on."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from cat3d_core.seva.checkpoint import random_seva
from cat3d_core.seva.config import TINY, SevaConfig
from cat3d_core.seva.network import SevaUNet, count_parameters, resized
from tests.core.seva.models import EXPECTED, fixture_network, inputs

TOLERANCE = 1e-4  # absolute, on outputs of about unit size (measured: 4.3e-6)


def _close(got, expected):
    torch.testing.assert_close(got, expected, rtol=0, atol=TOLERANCE)


@pytest.fixture(scope="module")
def original(shared_fixtures):
    return fixture_network(shared_fixtures)


def test_names_and_sizes_are_those_of_the_checkpoint(shared_fixtures):
    from cat3d_core.diffusion.ldm_names import from_ldm, to_ldm

    lines = (shared_fixtures / "seva_state_dict.txt").read_text().splitlines()
    rows = (line.split(" ", 1) for line in lines if not line.startswith("#"))
    theirs = {name: tuple(int(n) for n in shape.strip("[] ").split(",")) for name, shape in rows}
    with torch.device("meta"):
        own = {name: tuple(weight.shape) for name, weight in SevaUNet(SevaConfig()).state_dict().items()}
    ours = from_ldm(theirs)
    assert {ours[name]: shape for name, shape in theirs.items()} == own
    assert {name: ours for ours, name in to_ldm(own).items()} == ours


def test_number_of_weights():
    assert count_parameters(SevaConfig()) == 1_263_968_004
    with torch.device("meta"):
        assert len(SevaUNet(SevaConfig()).state_dict()) == 1146


@pytest.mark.parametrize(("context", "output"), [("in.context", "out.eps"), ("in.context_uneven", "out.eps_uneven")])
def test_output_agrees_with_the_original(original, context, output):
    network, f = original
    _close(network.folded(f["in.x"], f["in.t"], f["in.dense"], f[context], 5), f[output])


def test_single_views_agree_with_the_original(original):
    network, f = original
    got = network.folded(f["in.x"][:2], f["in.t"][[0, 5]], f["in.dense"][:2], f["in.context"][[0, 5]], 1)
    _close(got, f["out.eps_views1"])


def test_blocks_agree_with_the_original(original):
    """A residual block, a transformer on single views and a joint one."""
    network, f = original
    single, joint = network.down_blocks[0].attentions[0], network.up_blocks[2].attentions[0]
    _close(single(f["sub.transformer2d.in"], 5, f["in.context_uneven"]), f["sub.transformer2d.out"])
    _close(joint(f["sub.transformer3d.in"], 5, f["in.context_uneven"]), f["sub.transformer3d.out"])
    x, block = f["sub.resblock.in"], network.down_blocks[1].resnets[0]
    _close(block(x, F.silu(f["sub.resblock.emb"]), resized(f["in.dense"], x)), f["sub.resblock.out"])


def test_every_block_agrees_with_the_original(original):
    """Means and deviations of each channel after all 25 blocks, by the places of our modules."""
    network, f = original
    places: dict[str, torch.nn.Module] = {
        "input_blocks.0": network.conv_in,
        "middle_block": network.mid_block.resnets[1],
    }
    for level, down in enumerate(network.down_blocks):
        for i, resnet in enumerate(down.resnets):
            places[f"input_blocks.{3 * level + i + 1}"] = down.attentions[i] if len(down.attentions) else resnet
        for downsample in getattr(down, "downsamplers", []):
            places[f"input_blocks.{3 * level + 3}"] = downsample
    for level, up in enumerate(network.up_blocks):
        for i, resnet in enumerate(up.resnets):
            last = [*getattr(up, "upsamplers", [])] if i == 2 else []
            places[f"output_blocks.{3 * level + i}"] = [resnet, *([up.attentions[i]] if up.attentions else []), *last][
                -1
            ]
    seen = {}
    handles = [
        module.register_forward_hook(lambda _m, _i, out, name=name: seen.__setitem__(name, out))
        for name, module in places.items()
    ]
    network.folded(f["in.x"], f["in.t"], f["in.dense"], f["in.context"], 5)
    for handle in handles:
        handle.remove()
    blocks = {name.split(".", 1)[1].rsplit(".", 1)[0] for name in f if name.startswith("act.")}
    blocks.remove("time_embed")  # all others' input
    assert blocks == set(places)
    for name in blocks:
        _close(seen[name].mean((2, 3)), f[f"act.{name}.mean"])
        _close(seen[name].flatten(1).std(1), f[f"act.{name}.std"])


def test_output_is_what_it_was():
    """Expected numbers of our own, made when the network agreed with the original."""
    network = random_seva(TINY, seed=1)
    expected = load_file(EXPECTED)
    _close(network.folded(*inputs(2, 5), 5), expected["network.views5"])
    _close(network.folded(*inputs(2, 1), 1), expected["network.views1"])


def test_precisions_agree_with_float64():
    network, given = random_seva(TINY, seed=2), inputs(1, 3, 8, 8)
    exact = network.double().folded(given[0].double(), given[1], given[2].double(), given[3].double(), 3)
    scale = float(exact.std())
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.bfloat16, 0.1)):
        got = network.to(dtype).folded(given[0].to(dtype), given[1], given[2].to(dtype), given[3].to(dtype), 3)
        assert float((got.double() - exact).abs().max()) < tolerance * scale * 10
        assert float((got.double() - exact).square().mean().sqrt()) < tolerance * scale


def test_groups_do_not_meet_and_order_of_views_does_not_matter():
    network = random_seva(TINY, seed=3)
    x, time, rays, context = inputs(2, 4, 8, 8)
    context = context[::4].repeat_interleave(4, 0)
    both = network.folded(x, time, rays, context, 4)
    alone = network.folded(x[4:], time[4:], rays[4:], context[4:], 4)
    torch.testing.assert_close(both[4:], alone, rtol=0, atol=1e-5)
    order = torch.tensor([2, 0, 3, 1])
    moved = network.folded(x[order], time[order], rays[order], context[order], 4)
    torch.testing.assert_close(moved, both[order], rtol=0, atol=1e-5)


def test_forward_puts_its_inputs_together():
    network = random_seva(TINY, seed=4)
    x, time, rays, context = inputs(2, 3, 8, 8)
    latents, mask = x[:, :4].unflatten(0, (2, 3)), torch.tensor([[1.0, 0, 0], [1, 1, 0]])
    grouped = rays.unflatten(0, (2, 3))
    got = network(latents, time[::3], grouped, mask, context[::3])
    x = torch.cat([x[:, :4], mask.flatten()[:, None, None, None].expand(-1, 1, 8, 8), rays], 1)
    expected = network.folded(x, time, rays, context[::3].repeat_interleave(3, 0), 3)
    torch.testing.assert_close(got.flatten(0, 1), expected, rtol=0, atol=0)


def test_sides_that_cannot_be_halved_three_times_are_refused():
    network = random_seva(TINY)
    with pytest.raises(ValueError, match="multiples of 64 pixels, not 96 x 64"):
        network(
            torch.zeros(1, 2, 4, 8, 12),
            torch.zeros(1),
            torch.zeros(1, 2, 6, 8, 12),
            torch.zeros(1, 2),
            torch.zeros(1, 1, 24),
        )
