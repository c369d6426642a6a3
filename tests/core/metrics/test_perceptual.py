"""LPIPS against torchmetrics' code and the published check value; ST-LPIPS against its package; as a loss.

Tolerances: 1e-6 absolute in float32 against code that puts its epsilon elsewhere.
"""

from __future__ import annotations

import sys
import types

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from cat3d_core.metrics.backbones import ARCHITECTURES, build_features
from cat3d_core.metrics.perceptual import PerceptualDistance, find_linear_weights, find_perceptual, load_perceptual

BACKBONES = ["lpips-vgg", "lpips-alex", "lpips-squeeze"]


def linear_weights(name):
    path = find_linear_weights(name)
    if path is None:
        pytest.skip("Neither lpips nor torchmetrics is installed; they carry the linear weights.")
    return path


@pytest.fixture
def no_weights(monkeypatch, tmp_path):
    """A machine without any weights: no variable, an empty download cache, no package."""
    monkeypatch.delenv("CAT3D_LPIPS_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("cat3d_core.metrics.perceptual._package_folder", lambda *_: None)


def random_backbone(name, path):
    torch.manual_seed(0)
    save_file({f"features.{k}": v.contiguous() for k, v in build_features(name).state_dict().items()}, path)
    return path


def test_published_check_value_of_squeeze(shared_weights):
    """torchmetrics documents 0.1005 for these images (the stored backbone is float16, its own value 0.10049)."""
    linear_weights("lpips-squeeze")
    distance = load_perceptual(shared_weights / "squeezenet1_1_features.safetensors")
    assert distance.name == "lpips-squeeze"
    g = torch.manual_seed(42)
    a, b = (torch.rand(10, 3, 100, 100, generator=g) * 2 - 1 for _ in range(2))
    with torch.no_grad():
        raw = distance(a, b, normalize=False).mean()
        assert float(raw) == pytest.approx(0.10049, abs=5e-6)
        assert float(distance((a + 1) / 2, (b + 1) / 2).mean()) == pytest.approx(float(raw), abs=1e-6)


@pytest.mark.parametrize("name", BACKBONES)
def test_agrees_with_torchmetrics_code(name, tmp_path, monkeypatch, real_pairs):
    """Random backbones (the trained ones can't be had offline) in torchmetrics' own LPIPS, with its linear weights."""
    lpips = pytest.importorskip("torchmetrics.functional.image.lpips")
    linear_weights(name)
    path = random_backbone(name, tmp_path / "backbone.safetensors")
    features = build_features(name)
    features.load_state_dict({k.removeprefix("features."): v for k, v in load_file(path).items()})
    monkeypatch.setattr(lpips, "_get_tv_model_features", lambda *_, **__: features)
    theirs = lpips._LPIPS(net=name.removeprefix("lpips-"), pnet_rand=True)
    ours = load_perceptual(path)
    assert ours.name == name
    prediction, target = (x[:2, :, :64, :80] for x in real_pairs)
    with torch.no_grad():
        for normalize in (True, False):
            expected = theirs(prediction, target, normalize=normalize).flatten()
            torch.testing.assert_close(ours(prediction, target, normalize=normalize), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["st-lpips-alex", "st-lpips-vgg"])
def test_agrees_with_the_stlpips_package(name, monkeypatch, real_pairs):
    """The package's own code, with the imports it makes and doesn't need replaced by empty modules."""
    monkeypatch.delenv("CAT3D_LPIPS_WEIGHTS", raising=False)
    ours = find_perceptual(name)
    if ours is None:
        pytest.skip("stlpips-pytorch is not installed; it carries the ST-LPIPS weights.")
    for module, attribute in (("torchvision", "models"), ("IPython", "embed"), ("torchsummary", "summary")):
        stub = types.ModuleType(module)
        setattr(stub, attribute, types.ModuleType(attribute))
        monkeypatch.setitem(sys.modules, module, stub)
    stlpips = pytest.importorskip("stlpips_pytorch.stlpips")
    theirs = stlpips.LPIPS(net=name.removeprefix("st-lpips-"), variant="shift_tolerant", verbose=False)
    for size in (64, 21):
        prediction, target = (x[:2, :, :size, : size + 1] for x in real_pairs)
        with torch.no_grad():
            expected = theirs(prediction, target, normalize=True).flatten()
            torch.testing.assert_close(ours(prediction, target), expected, rtol=0, atol=1e-6)


def test_torchvision_is_never_imported():
    assert "torchvision" not in sys.modules


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_smallest_image_and_one_less(name):
    distance = PerceptualDistance(name)
    side = distance.architecture.smallest
    a, b = torch.rand(1, 3, side, side + 3), torch.rand(1, 3, side, side + 3)
    assert distance(a, b).isfinite().all()
    with pytest.raises(ValueError, match=f"{name} needs images of at least {side} pixels a side; these are 4096x1"):
        distance(torch.rand(1, 3, 1, 4096), torch.rand(1, 3, 1, 4096))
    with pytest.raises(ValueError, match=f"these are {side + 3}x{side - 1}"):
        distance(a[:, :, 1:], b[:, :, 1:])
    # One pixel less must not work inside either, or the bound is too strict.
    for layer in distance.features:
        if isinstance(layer, nn.ReLU):
            layer.inplace = False
    with pytest.raises((RuntimeError, AssertionError)):  # noqa: PT012
        for features in distance._unit_features(torch.rand(1, 3, side - 1, side - 1)):
            assert features.numel()


@pytest.mark.parametrize("name", ARCHITECTURES)
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_loss_on_patches_has_finite_gradients(name, value):
    """32x32 patches; flat ones, identical ones, and features that are all zero (weights set so)."""
    torch.manual_seed(0)
    distance = PerceptualDistance(name)
    flat = torch.full((2, 3, 32, 32), value)
    for target in (flat, torch.rand(2, 3, 32, 32)):
        prediction = flat.clone().requires_grad_()
        loss = distance(prediction, target)
        assert loss.shape == (2,)
        assert (loss >= 0).all()
        (gradient,) = torch.autograd.grad(loss.sum(), prediction)
        assert gradient.isfinite().all()
    assert (distance(flat, flat.clone()) == 0).all()
    for parameter in distance.features.parameters():
        parameter.zero_()
    prediction = torch.rand(2, 3, 32, 32, requires_grad=True)
    (gradient,) = torch.autograd.grad(distance(prediction, flat).sum(), prediction)
    assert gradient.isfinite().all()


@pytest.mark.parametrize("name", ["lpips-squeeze", "st-lpips-alex"])
def test_gradient_matches_finite_differences(name):
    torch.manual_seed(0)
    distance = PerceptualDistance(name).double()
    side = distance.architecture.smallest
    x, y = (torch.rand(1, 3, side, side, dtype=torch.float64) for _ in range(2))
    direction = torch.randn_like(x)
    (gradient,) = torch.autograd.grad(distance(x.requires_grad_(), y).sum(), x)
    with torch.no_grad():
        numeric = (distance(x + 1e-6 * direction, y) - distance(x - 1e-6 * direction, y)) / 2e-6
    assert float((gradient * direction).sum()) == pytest.approx(float(numeric), rel=1e-4)


@pytest.mark.parametrize("name", ["lpips-vgg", "st-lpips-alex"])
def test_symmetric_batched_and_close_to_float64(name):
    torch.manual_seed(0)
    distance = PerceptualDistance(name)
    x, y = torch.rand(3, 3, 40, 33), torch.rand(3, 3, 40, 33)
    with torch.no_grad():
        together = distance(x, y)
        torch.testing.assert_close(together, distance(y, x), rtol=0, atol=0)
        each = torch.cat([distance(x[i : i + 1], y[i : i + 1]) for i in range(3)])
        torch.testing.assert_close(together, each, rtol=1e-5, atol=1e-7)
        double = distance.double()(x, y)
        assert double.dtype == torch.float64
        torch.testing.assert_close(together.double(), double, rtol=1e-5, atol=1e-7)
        half = distance.to(torch.bfloat16)(x, y)
        assert half.dtype == torch.float32
        torch.testing.assert_close(half.double(), double, rtol=0.1, atol=1e-3)


@pytest.mark.parametrize("name", ["lpips-alex", "lpips-vgg", "st-lpips-alex"])
def test_one_small_pair_is_the_same_as_among_others(name):
    """It goes through the network in one batch with its target: another order of the same sums."""
    torch.manual_seed(0)
    distance = PerceptualDistance(name).double()
    one, other = (torch.rand(2, 3, 40, 40, dtype=torch.float64) for _ in range(2))
    one.requires_grad_(True)
    together = distance(one, other)
    (gradient,) = torch.autograd.grad(together.sum(), one)
    alone = distance(one[:1], other[:1])
    torch.testing.assert_close(alone, together[:1], rtol=1e-12, atol=0)
    torch.testing.assert_close(torch.autograd.grad(alone.sum(), one)[0][0], gradient[0], rtol=1e-9, atol=1e-14)


def test_only_images_get_gradients():
    distance = PerceptualDistance("lpips-squeeze")
    assert not any(p.requires_grad for p in distance.parameters())
    with pytest.raises(ValueError, match="these have 1 channels"):
        distance(torch.rand(1, 1, 32, 32), torch.rand(1, 1, 32, 32))
    with pytest.raises(ValueError, match="no perceptual network 'resnet'"):
        PerceptualDistance("resnet")


def test_nothing_installed_gives_none(no_weights):
    assert find_perceptual() is None
    with pytest.raises(ValueError, match="no perceptual network 'vgg'"):
        find_perceptual("vgg")


def test_finds_files_folders_and_torchvisions_cache(no_weights, tmp_path, monkeypatch):
    linear = linear_weights_before_patch
    monkeypatch.setattr("cat3d_core.metrics.perceptual.find_linear_weights", lambda name: linear.get(name))
    if not all(linear.values()):
        pytest.skip("Neither lpips nor torchmetrics is installed; they carry the linear weights.")
    cache = tmp_path / "cache" / "hub" / "checkpoints"
    cache.mkdir(parents=True)
    alex = random_backbone("lpips-alex", tmp_path / "a.safetensors")
    torch.save(load_file(alex) | {"classifier.1.weight": torch.zeros(2, 2)}, cache / "alexnet-owt-7be5be79.pth")
    assert find_perceptual().name == "lpips-alex"
    assert find_perceptual("lpips-squeeze") is None
    squeeze = random_backbone("lpips-squeeze", tmp_path / "some_name.safetensors")
    monkeypatch.setenv("CAT3D_LPIPS_WEIGHTS", str(squeeze))
    assert find_perceptual().name == "lpips-squeeze"
    assert find_perceptual("lpips-alex").name == "lpips-alex"
    folder = tmp_path / "folder"
    folder.mkdir()
    random_backbone("lpips-squeeze", folder / "squeezenet1_1_features.safetensors")
    monkeypatch.setenv("CAT3D_LPIPS_WEIGHTS", str(folder))
    assert find_perceptual("lpips-squeeze").name == "lpips-squeeze"
    monkeypatch.setenv("CAT3D_LPIPS_WEIGHTS", str(tmp_path / "absent.pth"))
    with pytest.raises(ValueError, match=r"CAT3D_LPIPS_WEIGHTS: .*absent.pth: there is no such file"):
        find_perceptual()


linear_weights_before_patch = {name: find_linear_weights(name) for name in BACKBONES}


def test_bad_files_are_named(tmp_path, shared_weights):
    garbage = tmp_path / "garbage.safetensors"
    garbage.write_bytes(b"not a tensor file at all")
    with pytest.raises(ValueError, match="garbage.safetensors: not a readable file"):
        load_perceptual(garbage)
    pickled = tmp_path / "pickled.pth"
    torch.save({"features.0.weight": nn.Linear(1, 1)}, pickled)
    with pytest.raises(ValueError, match="pickled.pth: not a readable file of plain tensors"):
        load_perceptual(pickled)
    with pytest.raises(ValueError, match="taef2_decoder.safetensors: neither SqueezeNet"):
        load_perceptual(shared_weights / "taef2_decoder.safetensors")
    path = random_backbone("lpips-squeeze", tmp_path / "whole.safetensors")
    state = load_file(path)
    del state["features.9.squeeze.weight"]
    save_file(state, tmp_path / "part.safetensors")
    linear = linear_weights("lpips-squeeze")
    with pytest.raises(ValueError, match=r"part.safetensors: looks like lpips-squeeze, .* layer 9.squeeze.weight"):
        load_perceptual(tmp_path / "part.safetensors", linear)
    with pytest.raises(ValueError, match=r"alex.pth: not the linear weights of lpips-squeeze \(lin1"):
        load_perceptual(path, linear_weights("lpips-alex"))


def test_a_backbone_without_linear_weights_says_what_to_do(no_weights, tmp_path):
    path = random_backbone("lpips-squeeze", tmp_path / "backbone.safetensors")
    with pytest.raises(ValueError, match="Install lpips or torchmetrics"):
        load_perceptual(path)
