"""What every generator of views offers, and what it is asked: p(target views | given views, cameras), paper section 3.

Cameras go in, not raymaps, and images beside latents: how they enter a network is the generator's own matter, and so
are padding, batches and memory. Tensors come back on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from cat3d_core.cameras import Cameras
from cat3d_core.diffusion.memory import Need
from cat3d_core.diffusion.sampler import SamplerConfig


class Cost(NamedTuple):
    """Work of sampling one group: evaluations of the network, and floating-point operations of them all."""

    evaluations: int
    flops: float


@dataclass(frozen=True)
class GeneratorSpec:
    """What a generator is, known without its weights. Equal identities: equal results.

    views: given and target views at once, at most. given: the numbers of given views it takes. image_size: (width,
    height) of its images in pixels; latent_shape: (C, h, w) of one view. identity: hash of all that decides results;
    encoder_identity: of the part that makes latents. advice: how to sample with it; reference: how its authors do.
    cost(given, targets, sampler): of one group. wants: those of the optional fields of `ViewGroup` that it uses.
    layout: how a plan groups views for it: "groups" as the paper does, or "windows", anchors along the path first and
    then what lies between them, with captured views in each (`cat3d_core.windows`). terms: what its licence says
    of what is made with it, in a sentence; empty: nothing that need be said. need(groups, dtype): memory of sampling so
    many groups at once; None: so little that nobody asks. at(views, side): the spec with so many views at once, of
    square images with sides of so many pixels, None: as it is; ValueError where that can't be. None: never.
    """

    views: int
    given: tuple[int, ...]
    image_size: tuple[int, int]
    latent_shape: tuple[int, int, int]
    identity: str
    encoder_identity: str
    advice: SamplerConfig
    reference: SamplerConfig
    cost: Callable[[int, int, SamplerConfig], Cost] = field(compare=False)
    wants: frozenset[str] = frozenset()
    layout: Literal["groups", "windows"] = "groups"
    terms: str = ""
    need: Callable[[int, torch.dtype], Need] | None = field(default=None, compare=False)
    at: Callable[[int | None, int | None], GeneratorSpec] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class ViewGroup:
    """M given and N target views that are sampled together; a group's result depends on nothing but the group.

    latents (M, C, h, w) float32 of the given views, as `encode` made them; cameras: M + N, given ones first, of images
    of the generator's size, in the scene frame (mean distance 1, +z up); noise (N, C, h, w) standard normal, a view's
    own whatever its group. Optional, for those who want it (`GeneratorSpec.wants`): images (M, 3, H, W) float32 in
    [0, 1] of the given views; scene: the cameras of all captured views; hints: maps by name of what is known of the
    targets beforehand, as a plane sweep of photos finds it: colour (N, 3, H, W) in [0, 1], and (N, H, W) confidence,
    inverse_depth, spread, seen (`cat3d_core.matching.hint.Hint`), or empty; planned: the cameras of all planned views
    of the same sample set.
    """

    latents: Tensor
    cameras: Cameras
    noise: Tensor
    images: Tensor | None = None
    scene: Cameras | None = None
    hints: Mapping[str, Tensor] = field(default_factory=dict)
    planned: Cameras | None = None

    def __post_init__(self) -> None:
        given, targets = len(self.latents), len(self.noise)
        if given < 1 or targets < 1 or len(self.cameras) != given + targets:
            raise ValueError(
                f"A group has at least one given and one target view, and a camera for each; got {given} given views, "
                f"{targets} target views and {len(self.cameras)} cameras."
            )


class Generator(Protocol):
    """Encode, sample, decode. Methods take tensors from any device and give them back on the CPU.

    spec: where that has `at`, another one of those may be put in its place, for samples as that says.
    """

    spec: GeneratorSpec

    def encode(self, images: Tensor) -> Tensor:
        """Images (B, 3, H, W) in [0, 1] -> latents (B, C, h, w) float32."""
        ...

    def sample(self, groups: Iterable[ViewGroup], sampler: SamplerConfig) -> Iterator[Tensor]:
        """Latents (N, C, h, w) float32 of the target views of each group, in order, as soon as they are there.

        `sampler.micro_batch` groups go through the network together (None: one), fewer where memory doesn't hold them.
        Raises MemoryTooSmall where it doesn't hold one.
        """
        ...

    def decode(self, latents: Tensor) -> Tensor:
        """Latents (B, C, h, w) -> images (B, 3, H, W) float32 in [0, 1]."""
        ...
