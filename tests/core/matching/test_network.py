"""The network's promises: any number of photos, in any order, of any scene frame; finite everywhere."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from cat3d_core.cameras import Cameras
from cat3d_core.matching.checkpoint import describe_sweep, load_sweep, save_sweep
from cat3d_core.matching.composite import Composite
from cat3d_core.matching.config import SweepConfig
from cat3d_core.matching.hint import Hint, hint, observe, photo_depth
from cat3d_core.matching.network import SweepNetwork, partners
from cat3d_core.matching.warp import pair_maps, project, take, views
from tests.core.strategies import orbit, random_similarity

SMALL = SweepConfig(
    encoder=(8, 8, 16, 16), coarse_features=8, fine_features=8, photo_planes=16, target_planes=16, hypotheses=4,
    volume=(8, 8, 8), finish=(8, 8, 8, 8),
)  # fmt: skip


@pytest.fixture(scope="module")
def network() -> SweepNetwork:
    """Small, with every weight random (fresh ones have zeros at their ends), so that everything has an effect."""
    torch.manual_seed(0)
    out = SweepNetwork(SMALL)
    for parameter in out.parameters():
        if parameter.dim() > 1:
            torch.nn.init.normal_(parameter, std=float(parameter[0].numel()) ** -0.5)
    return out.eval().requires_grad_(False)


def scene(count: int, size: int = 32) -> tuple[Tensor, Cameras]:
    image = torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(1))
    return image, orbit(count + 2, width=size, height=size)


def hints(network: SweepNetwork, image: Tensor, cameras: Cameras) -> Hint:
    """The last two cameras are targets."""
    count = len(image)
    return hint(network, observe(network, image, cameras[slice(0, count)]), cameras[slice(count, None)])


@pytest.mark.parametrize("count", [1, 2, 3, 5, 10])
def test_any_number_of_photos(network: SweepNetwork, count: int) -> None:
    found = hints(network, *scene(count))
    assert found.colour.shape == (2, 3, 32, 32)
    for name in ("confidence", "inverse_depth", "spread", "seen"):
        values = getattr(found, name)
        assert values.shape == (2, 32, 32)
        assert torch.isfinite(values).all()
        assert float(values.min()) >= 0
    assert float(found.confidence.max()) <= 1
    assert found.photos.shape == found.share.shape[:2] == (2, min(count, 9))
    torch.testing.assert_close(found.share.sum(1), torch.ones(2, 32, 32), rtol=0, atol=1e-4)


def test_order_of_the_photos_does_not_matter(network: SweepNetwork) -> None:
    image, cameras = scene(4)
    here = hints(network, image, cameras)
    order = [2, 0, 3, 1]
    tail = Cameras.cat([cameras[order], cameras[slice(4, None)]])
    there = hints(network, image[order], tail)
    torch.testing.assert_close(there.colour, here.colour, rtol=0, atol=2e-4)
    torch.testing.assert_close(there.inverse_depth, here.inverse_depth, rtol=0, atol=2e-3)


def test_rigid_motions_of_the_world_do_not_matter(network: SweepNetwork) -> None:
    image, cameras = scene(3)
    moved = random_similarity(3, scaled=False).cameras(cameras)
    here, there = hints(network, image, cameras), hints(network, image, moved)
    torch.testing.assert_close(there.colour, here.colour, rtol=0, atol=2e-4)
    torch.testing.assert_close(there.inverse_depth, here.inverse_depth, rtol=0, atol=2e-3)


def test_targets_of_another_size_than_the_photos(network: SweepNetwork) -> None:
    image, cameras = scene(2)
    found = hint(network, observe(network, image, cameras[[0, 1]]), cameras[[2, 3]].resize(64, 48))
    assert found.colour.shape == (2, 3, 48, 64)


def test_photos_have_a_depth_of_their_own(network: SweepNetwork) -> None:
    image, cameras = scene(3)
    depth, error = photo_depth(network, observe(network, image, cameras[[0, 1, 2]]))
    assert depth.shape == error.shape == (3, 16, 16)
    assert float(depth.min()) >= 0
    assert float(depth.max()) <= SMALL.nearest * 1.0001
    assert float(error.min()) >= 0


def test_sharp_blending_takes_the_likeliest_hypothesis_alone(network: SweepNetwork) -> None:
    """One photo: at the limit each pixel has the colour of one place of it, and no geometry changes."""
    image = torch.randint(0, 2, (1, 3, 32, 32), generator=torch.Generator().manual_seed(2)).float()
    image = functional.interpolate(image[..., ::8, ::8], (32, 32), mode="nearest")
    cameras = scene(1)[1]
    soft, sharp, found = network.config, dataclasses.replace(network.config, sharpness=(1e4, 1e4)), {}
    for config in (soft, sharp):
        network.config = config
        observed = network.observe(image, views(cameras[[0]]), partners(views(cameras[[0]]).pose, 3))
        found[config] = network(observed, torch.zeros(2, 1, dtype=torch.int64), views(cameras[[1, 2]]), 32, 32)
    network.config = soft
    likeliest = found[sharp].probability.argmax(1, keepdim=True)
    at = project(pair_maps(views(cameras[[1, 2]]), views(cameras[[0, 0]])[:, None]),
                 found[sharp].hypotheses.gather(1, likeliest))  # fmt: skip
    expected = take(image.expand(2, -1, -1, -1), at.grid[:, 0])[:, :, 0]
    torch.testing.assert_close(found[sharp].blended, expected, rtol=0, atol=1e-4)
    assert float((found[soft].blended - expected).abs().mean()) > 0.02
    for name in ("inverse_depth", "spread", "seen", "probability"):
        assert torch.equal(getattr(found[sharp], name), getattr(found[soft], name))


def test_what_does_not_fit_is_refused(network: SweepNetwork) -> None:
    image, cameras = scene(2)
    with pytest.raises(ValueError, match="each photo needs one"):
        observe(network, image, cameras)
    with pytest.raises(ValueError, match="divisible by 16"):
        observe(network, image[..., :30], cameras[[0, 1]].crop(0, 0, 30, 32))
    several = Cameras.cat([cameras[2], cameras[3].resize(64, 64)])
    with pytest.raises(ValueError, match="one image size"):
        hint(network, observe(network, image, cameras[[0, 1]]), several)


def test_files_keep_the_network(network: SweepNetwork, tmp_path: Path) -> None:
    path = tmp_path / "sweep.safetensors"
    digest = save_sweep(path, network, {"data": "none"}, Composite(0.4, 0.1))
    again = load_sweep(path)
    assert again.config == SMALL
    assert again.composite == Composite(0.4, 0.1)
    assert describe_sweep(path)["sha256"] == digest
    image, cameras = scene(2)
    assert torch.equal(hints(again, image, cameras).colour, hints(network, image, cameras).colour)
    content = bytearray(path.read_bytes())
    content[-8] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(ValueError, match="damaged"):
        load_sweep(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    from cat3d_core.weights_file import write_weights

    path = tmp_path / "other.safetensors"
    write_weights(path, {"a": torch.zeros(1)}, {"format": "cat3d.multiview.1"})
    with pytest.raises(ValueError, match="no plane sweep"):
        load_sweep(path)


def test_composite_follows_confidence() -> None:
    mix = Composite(0.5, 0.01)
    colour, sample = torch.ones(1, 3, 1, 2), torch.zeros(1, 3, 1, 2)
    out = mix(colour, torch.tensor([[[0.9, 0.1]]]), sample)
    torch.testing.assert_close(out, torch.tensor([1.0, 0.0]).expand(1, 3, 1, 2), rtol=0, atol=1e-6)


def test_partners_are_the_nearest_others() -> None:
    """On a line at 0, 1, 3, 7, looking one way: nobody is their own partner."""
    pose = torch.eye(4).repeat(4, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.0, 1.0, 3.0, 7.0])
    assert partners(pose, 2).tolist() == [[1, 2], [0, 2], [1, 0], [2, 1]]
    assert partners(pose, 9).shape == (4, 3)
    assert partners(pose[:1], 2).shape == (1, 0)
