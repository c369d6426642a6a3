"""LPIPS (Zhang et al. 2018) and shift-tolerant LPIPS (Ghildyal & Liu 2022), from weights the user has.

A distance is named after what was measured: `lpips-vgg`, `lpips-alex`, `lpips-squeeze` (ImageNet backbones with the
published v0.1 linear weights) or `st-lpips-alex`, `st-lpips-vgg` (trained from scratch on BAPPS: never LPIPS). Nothing
is downloaded, and no file is unpickled beyond plain tensors.
"""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from cat3d_core.metrics.backbones import ARCHITECTURES, build_features
from cat3d_core.metrics.images import image_pair
from cat3d_core.metrics.weights import read_tensors

# Of torchvision's ImageNet statistics, for inputs in [-1, 1] (LPIPS v0.1's scaling layer).
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-8
#: Pixels up to which two images go through the network together where one alone would be slow.
SMALL_AREA = 64 * 64


class PerceptualDistance(nn.Module):
    """Distance between deep features of two images, also for use as a training loss.

    `name` is a key of ARCHITECTURES. Weights are frozen; they start random, `load_perceptual` fills them.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, name: str) -> None:
        super().__init__()
        if name not in ARCHITECTURES:
            raise ValueError(f"There is no perceptual network '{name}'; choose one of {', '.join(ARCHITECTURES)}.")
        self.name = name
        self.architecture = ARCHITECTURES[name]
        self.features = build_features(name)
        self.linear = nn.ParameterList([torch.ones(count) for count in self.architecture.channels])
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1), persistent=False)
        self.requires_grad_(False)

    def _unit_features(self, images: Tensor) -> Iterator[Tensor]:
        activation = images
        for index, layer in enumerate(self.features):
            activation = layer(activation)
            if index in self.architecture.taps:
                wide = activation.to(torch.promote_types(activation.dtype, torch.float32))
                # The epsilon is inside the root: outside, the gradient at a zero feature vector is 0 / 0.
                yield wide / (wide.square().sum(dim=1, keepdim=True) + _EPSILON).sqrt()

    def forward(self, prediction: Tensor, target: Tensor, normalize: bool = True) -> Tensor:
        """Distance of each pair: (B,), 0 for identical images; float32 or wider.

        prediction, target (B, 3, h, w) in [0, 1]. With `normalize=False` they go into the network as they are and not
        scaled to [-1, 1]: what FreeNeRF and the Gaussian splatting family report for images in [0, 1]. Differentiable
        in both. Raises ValueError for images smaller than the deepest layer needs, or without three channels.
        """
        prediction, target, _ = image_pair(prediction, target)
        _, channels, height, width = prediction.shape
        if channels != 3:
            raise ValueError(f"{self.name} compares colour images (B, 3, h, w); these have {channels} channels.")
        if min(height, width) < self.architecture.smallest:
            raise ValueError(
                f"{self.name} needs images of at least {self.architecture.smallest} pixels a side; "
                f"these are {width}x{height} (width x height)."
            )
        dtype = self.linear[0].dtype

        def prepared(images: Tensor) -> Tensor:
            images = 2.0 * images - 1.0 if normalize else images
            return ((images.to(dtype) - self.shift) / self.scale).to(dtype)

        first, second = prepared(prediction), prepared(target)
        features: Iterable[tuple[Tensor, Tensor]]
        if len(first) == 1 and height * width <= SMALL_AREA:
            # PyTorch leaves one small image to a slow convolution: a training patch took 23 ms so, two together 14.
            both = self._unit_features(torch.cat([first, second]))
            features = ((layer[:1], layer[1:]) for layer in both)
        else:
            features = zip(self._unit_features(first), self._unit_features(second), strict=True)
        layers = [
            ((a - b).square() * w.to(a.dtype).view(1, -1, 1, 1)).sum(dim=1).mean(dim=(1, 2))
            for w, (a, b) in zip(self.linear, features, strict=True)
        ]
        return torch.stack(layers).sum(dim=0)


def _recognise(state: dict[str, Tensor]) -> str | None:
    """Which network a state dictionary belongs to, by its key names."""
    first = state.get("net.slice1.0.weight", state.get("features.0.weight"))
    if first is None:
        return None
    family = "st-lpips" if "net.slice1.0.weight" in state else "lpips"
    if "features.3.squeeze.weight" in state:
        return f"{family}-squeeze"
    shape = tuple(first.shape)
    return f"{family}-alex" if shape == (64, 3, 11, 11) else f"{family}-vgg" if shape == (64, 3, 3, 3) else None


def _package_folder(package: str, *inside: str) -> Path | None:
    """A folder inside an installed package, found without importing it."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(next(iter(spec.submodule_search_locations)), *inside)
    return folder if folder.is_dir() else None


def find_linear_weights(name: str) -> Path | None:
    """The published v0.1 linear weights of `name` (`lpips-...`) in the installed package lpips or torchmetrics."""
    file = f"{name.removeprefix('lpips-')}.pth"
    folders = (
        _package_folder("lpips", "weights", "v0.1"),
        _package_folder("torchmetrics", "functional", "image", "lpips_models"),
    )
    return next((folder / file for folder in folders if folder is not None and (folder / file).is_file()), None)


def load_perceptual(path: str | Path, linear: str | Path | None = None) -> PerceptualDistance:
    """A distance from a file of weights: .safetensors, or .pth / .pt of plain tensors.

    Either a backbone with torchvision's key names (SqueezeNet 1.1, AlexNet, VGG16; a classifier in it is ignored),
    which needs the v0.1 linear weights beside it (`linear`; by default those of the installed package lpips or
    torchmetrics), or an ST-LPIPS file, which is complete. Raises ValueError naming the file for anything else.
    """
    path = Path(path)
    state = read_tensors(path)
    name = _recognise(state)
    if name is None:
        raise ValueError(
            f"{path}: neither SqueezeNet 1.1, AlexNet or VGG16 in torchvision's key names nor an ST-LPIPS file."
        )
    heads, heads_path = state, path
    if not name.startswith("st-"):
        found = Path(linear) if linear is not None else find_linear_weights(name)
        if found is None:
            raise ValueError(
                f"{path}: a backbone alone; LPIPS also needs its linear weights. Install lpips or torchmetrics "
                "(they carry them) or give their file."
            )
        heads, heads_path = read_tensors(found), found
    distance = PerceptualDistance(name)
    # ST-LPIPS files keep a layer's index but nest it in a slice: net.slice2.5.weight is layer 5's.
    layers = {re.sub(r"^(features|net\.slice\d+)\.", "", key): value for key, value in state.items()}
    for key, parameter in distance.features.named_parameters():
        if key not in layers or layers[key].shape != parameter.shape:
            raise ValueError(f"{path}: looks like {name}, but the weights of layer {key} are missing or do not fit.")
        parameter.copy_(layers[key])
    for index, parameter in enumerate(distance.linear):
        head = heads.get(f"lin{index}.model.1.weight")
        if head is None or head.numel() != parameter.numel():
            raise ValueError(f"{heads_path}: not the linear weights of {name} (lin{index} is missing or does not fit).")
        parameter.copy_(head.flatten())
    return distance.eval()


_BACKBONE_FILES = {"lpips-vgg": "vgg16", "lpips-alex": "alexnet", "lpips-squeeze": "squeezenet1_1"}


def _candidates(name: str) -> Iterator[Path]:
    """Files that may hold the network `name`: the user's folder, torchvision's download cache, an installed package."""
    given = os.environ.get("CAT3D_LPIPS_WEIGHTS")
    folders = [Path(given)] if given and Path(given).is_dir() else []
    if name in _BACKBONE_FILES:
        folders.append(Path(torch.hub.get_dir()) / "checkpoints")
        pattern = f"{_BACKBONE_FILES[name]}*"
    else:
        package = _package_folder("stlpips_pytorch", "weights", "vST0.0")
        folders += [package] if package else []
        pattern = f"{name.removeprefix('st-lpips-')}_shift_tolerant*"
    for folder in folders:
        yield from sorted(p for p in folder.glob(pattern) if p.suffix in (".safetensors", ".pth", ".pt"))


def _located(name: str | None) -> tuple[str, Path] | None:
    """Name and file of the network that `find_perceptual` loads."""
    if name is not None and name not in ARCHITECTURES:
        raise ValueError(f"There is no perceptual network '{name}'; choose one of {', '.join(ARCHITECTURES)}.")
    given = os.environ.get("CAT3D_LPIPS_WEIGHTS")
    if given and not Path(given).is_dir():
        try:
            found = load_perceptual(given).name
        except ValueError as error:
            raise ValueError(f"CAT3D_LPIPS_WEIGHTS: {error}") from error
        if name in (None, found):
            return found, Path(given)
    for wanted in ARCHITECTURES if name is None else (name,):
        if wanted in _BACKBONE_FILES and find_linear_weights(wanted) is None:
            continue
        for path in _candidates(wanted):
            return wanted, path
    return None


def find_perceptual(name: str | None = None) -> PerceptualDistance | None:
    """The best perceptual distance whose weights are on this machine, or None; `.name` says which it is.

    Looks at CAT3D_LPIPS_WEIGHTS (a file, which then is the answer, or a folder of them), torchvision's download cache
    and the package stlpips-pytorch, for, in this order unless `name` asks for one: lpips-vgg (what the paper's tables
    use), lpips-alex, lpips-squeeze, st-lpips-alex, st-lpips-vgg (the larger ST network is asked for by name).
    Raises ValueError for an unknown name, or where the variable names something that can't be used.
    """
    located = _located(name)
    return load_perceptual(located[1]) if located else None


def perceptual_name(name: str | None = None) -> str | None:
    """The name of what `find_perceptual` finds, without loading it where the place tells."""
    located = _located(name)
    return located[0] if located else None
