"""The shape of SEVA's network (Zhou et al. 2025, "Stable Virtual Camera")."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SevaConfig:
    """A U-Net of Stable Diffusion 2.1's layout whose views meet in its middle and its up path, and in every place.

    channels: of the four levels, which work at 1/8, 1/16, 1/32 and 1/64 of the image's size; head_channels: of one
    attention head; context_channels: of the image embedding; views: in one window as trained (the network itself takes
    any number); image_size: side in pixels of the images it was trained on (any multiples of `multiple` will do).
    """

    channels: tuple[int, int, int, int] = (320, 640, 1280, 1280)
    head_channels: int = 64
    context_channels: int = 1024
    views: int = 21
    image_size: int = 576

    #: Residual blocks of a level on the way down; one more on the way up.
    blocks = 2
    latent_channels = 4
    #: Sides of images are multiples of this: eight times smaller as latents, and halved three times in the network.
    multiple = 64

    def __post_init__(self) -> None:
        for channels in self.channels:
            if channels % 32 or channels % self.head_channels:
                raise ValueError(
                    f"{channels} channels can't be split into 32 norm groups and heads of {self.head_channels} "
                    f"channels."
                )
        if self.image_size % self.multiple or self.image_size <= 0:
            raise ValueError(f"Images of {self.image_size} pixels a side are not multiples of {self.multiple}.")


#: A network of a few hundred thousand weights with the names of the real one, for tests.
TINY = SevaConfig(channels=(32, 64, 32, 32), head_channels=16, context_channels=24, views=5, image_size=64)
