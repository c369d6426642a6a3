"""The radiance field: hash grid features to density, and to colour for the final round (Zip-NeRF)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from cat3d_core.random import generator
from cat3d_core.zipnerf.config import ZipNerfConfig
from cat3d_core.zipnerf.gradients import safe_exp
from cat3d_core.zipnerf.grid_layout import make_layout
from cat3d_core.zipnerf.hash_grid import query
from cat3d_core.zipnerf.layers import Layer, chain


def encode_directions(unit: Tensor, degree: int) -> Tensor:
    """Positional encoding (..., 3 + 6 degree) of unit directions (..., 3): identity, then sin and cos of 2^k d."""
    scaled = (unit[..., None, :] * 2.0 ** torch.arange(degree, dtype=unit.dtype, device=unit.device)[:, None]).flatten(
        -2
    )
    return torch.cat([unit, scaled.sin(), scaled.cos()], -1)


class GridDensity(nn.Module):
    """One hash grid and the layers that read it: features of cone samples -> hidden units -> density."""

    def __init__(self, config: ZipNerfConfig, round_index: int) -> None:
        super().__init__()
        self.gain, self.init, self.bias = config.grid_gain, config.grid_init, config.density_bias
        self.layout = make_layout(
            config.grid_base, config.grid_max[round_index], config.grid_log2_table, config.grid_features[round_index]
        )
        self.table = nn.Parameter(torch.empty(self.layout.rows, self.layout.features))
        self.hidden = nn.Linear(self.layout.levels * (self.layout.features + 1), config.density_width)
        self.density = nn.Linear(config.density_width, 1)
        self.final = round_index == config.rounds - 1

    def level_rows(self) -> list[tuple[int, int]]:
        return list(zip(self.layout.offsets[:-1], self.layout.offsets[1:], strict=True))

    def forward(self, positions: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """Cone samples (R, N, S, 3), (R, N, S) in the unit cube (`grid_samples`) -> density (R, N) per scene unit,
        hidden units (R, N, width) for the colour; of proposals, which have none, width 0."""
        rays, intervals, samples = std.shape
        found = query(self.table, positions.reshape(-1, samples, 3), std.reshape(-1, samples), self.layout)
        layers = [self._first_layer(), Layer(self.density.weight, self.density.bias[None] + self.bias)]
        *hidden, density = chain(found.flatten(1), layers, (self.final, True))
        shown = hidden[0] if hidden else density[:, :0]
        return safe_exp(density.view(rays, intervals)), shown.view(rays, intervals, -1)

    def _first_layer(self) -> Layer:
        """`hidden` as it reads what `query` gives: features times the gain, and of each level the scale feature
        (2 weight - 1) sqrt(init^2 + mean square) (Zip-NeRF sec. 2), which tells how much of it was weighted away. Both
        are linear, so the weights take them over."""
        weight = self.hidden.weight.view(-1, self.layout.levels, self.layout.features + 1)
        with torch.no_grad():
            counts = [b - a for a, b in self.level_rows()]
            norms = torch.stack(torch._foreach_norm(self.table.detach().split(counts)))
            numbers = torch.tensor(counts, device=norms.device) * self.layout.features
            size = self.gain * (self.init**2 + norms.square() / numbers).sqrt()
            scale = torch.full_like(weight[0], self.gain)
            scale[:, -1] = 2.0 * size
        bias = self.hidden.bias - weight[..., -1] @ size
        return Layer((weight * scale).flatten(1), bias[None], True)


class ViewColour(nn.Module):
    """Colour of hidden units seen from a direction: bottleneck, directions, a small network, padded sigmoid."""

    def __init__(self, config: ZipNerfConfig) -> None:
        super().__init__()
        self.degree, self.padding = config.view_degree, config.rgb_padding
        self.bottleneck = nn.Linear(config.density_width, config.bottleneck_width)
        inputs = config.bottleneck_width + 3 + 6 * config.view_degree
        widths = [inputs] + [config.view_width] * config.view_depth
        self.layers = nn.ModuleList([nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)])
        # With more than one layer the input is concatenated again before the last, as in Zip-NeRF.
        self.skip = config.view_depth > 1
        self.rgb = nn.Linear(widths[-1] + (inputs if self.skip else 0), 3)

    def forward(self, hidden: Tensor, directions: Tensor) -> Tensor:
        """hidden (R, N, width), directions (R, 3) -> rgb (R, N, 3) in [0, 1] up to the padding."""
        unit = directions / directions.norm(dim=-1, keepdim=True)
        view = encode_directions(unit, self.degree)
        rows, middle = hidden.flatten(0, 1), self.bottleneck
        if not self.skip:
            # The directions are those of all intervals of a ray: their part of the layer is computed once a ray.
            [first], width = self.layers, middle.out_features
            weights = first.get_parameter("weight")
            seen = torch.addmm(first.get_parameter("bias"), view, weights[:, width:].T)
            layers = [Layer(middle.weight, middle.bias[None]), Layer(weights[:, :width], seen, True)]
            [raw] = chain(rows, [*layers, Layer(self.rgb.weight, self.rgb.bias[None])], (False, False, True))
        else:
            inputs = torch.cat([middle(rows), view.repeat_interleave(hidden.shape[1], 0)], -1)
            x = inputs
            for layer in self.layers:
                x = torch.relu(layer(x))
            raw = self.rgb(torch.cat([x, inputs], -1))
        raw = raw.view(*hidden.shape[:2], 3)
        return torch.sigmoid(raw) * (1.0 + 2.0 * self.padding) - self.padding


class Field(nn.Module):
    """Proposal densities and the final radiance field of one scene, in normalised scene coordinates."""

    def __init__(self, config: ZipNerfConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        self.grids = nn.ModuleList([GridDensity(config, index) for index in range(config.rounds)])
        self.colour = ViewColour(config)
        draw = generator(seed, "nerf", "init")
        with torch.no_grad():
            for module in self.modules():
                if isinstance(module, GridDensity):
                    module.table.uniform_(-config.grid_init, config.grid_init, generator=draw)
                elif isinstance(module, nn.Linear):  # he_uniform
                    bound = math.sqrt(6.0 / module.in_features)
                    module.weight.uniform_(-bound, bound, generator=draw)
                    module.bias.zero_()

    @classmethod
    def from_state(cls, config: ZipNerfConfig, state: Mapping[str, Tensor]) -> Field:
        """Field from `Trainer.state()` or its own state dict. Raises ValueError where names or shapes do not fit the
        config."""
        own = {
            name.removeprefix("field."): value
            for name, value in state.items()
            if not name.startswith(("adam.", "trainer."))
        }
        field = cls(config)
        try:
            field.load_state_dict(own)
        except RuntimeError as error:
            raise ValueError(f"The stored field does not fit this reconstruction config: {error}") from error
        return field
