"""Every family: seeded, upright, free cameras that see content; errors."""

import pytest
import torch

from cat3d_core.normalization import normalize_scene
from cat3d_core.synthetic import FAMILIES, Scene, random_cameras, random_scene, trace
from cat3d_core.synthetic.capture import CLEARANCE
from cat3d_core.synthetic.scene import slot_range


def tensors(scene: Scene) -> dict[str, torch.Tensor]:
    return {name: getattr(scene, name) for name in Scene._tensor_names()}


@pytest.mark.parametrize("family", FAMILIES)
def test_the_seed_decides(family):
    one, same, other = random_scene(family, 1), random_scene(family, 1), random_scene(family, 2)
    assert all(torch.equal(a, b) for a, b in zip(tensors(one).values(), tensors(same).values(), strict=True))
    assert not torch.equal(one.textures, other.textures)
    a, b = (random_cameras(one, 3, 4, 32, 32).world_from_camera for _ in range(2))
    assert torch.equal(a, b)
    assert not torch.equal(a, random_cameras(one, 4, 4, 32, 32).world_from_camera)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", range(4))
def test_captures_are_sound(family, seed):
    scene = random_scene(family, seed)
    cameras = random_cameras(scene, seed, 20, 48, 48)
    cameras.validate()
    # Nothing upside down, no camera rolled by more than a few degrees.
    assert (cameras.up[:, 2] > 0.3).all()
    assert (cameras.rotation[:, 2, 0].abs() < 0.06).all()
    centres = cameras.centers.float()
    maps = scene.object_from_world[0]
    local = torch.einsum("pij,nj->pni", maps[:, :, :3], centres) + maps[:, None, :, 3]
    active = scene.active[0]
    solids = slot_range("sphere").start
    assert not (((local[solids:].abs() < 1).all(-1)) & active[solids:, None]).any(), "a camera inside a solid"
    room = slot_range("room").start
    if active[room]:
        assert (local[room].abs() < 1).all()
    else:
        assert (centres[:, 2] > 0).all()
    out = trace(scene, cameras.resize(16, 16), supersample=1)
    assert out.depth.min() > 0.5 * CLEARANCE * float(scene.reach[0])
    assert (out.depth.isfinite().float().mean((1, 2)) > 0.25).all(), "a camera that sees nothing"
    assert 0.03 < float(out.image.mean()) < 0.97
    assert float(out.image.std()) > 0.02
    towards = (out.normal * -(cameras.forward.float()[:, :, None, None])).sum(1)
    assert (towards > -0.9).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_spread_brings_cameras_together(family):
    scene = random_scene(family, 7)
    near, far = (random_cameras(scene, 0, 16, 32, 32, spread=s).centers.std(0).norm() for s in (0.2, 1.0))
    assert near < 0.75 * far


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_alone_gives_cameras_that_normalise(family):
    cameras = random_cameras(family, 0, 12, 64, 48)
    assert cameras.size.tolist() == [[64, 48]] * 12
    normal = normalize_scene(cameras).cameras(cameras)
    assert normal.centers.norm(dim=-1).median() < 5


def test_photographs_become_textures():
    photos = torch.rand(2, 3, 40, 60, generator=torch.Generator().manual_seed(0))
    plain, papered = random_scene("dtu", 0), random_scene("dtu", 0, textures=photos)
    assert plain.textures.shape == papered.textures.shape
    assert not torch.equal(plain.textures, papered.textures)


def test_textures_differ_within_a_scene():
    textures = random_scene("co3d", 0).textures[0]
    distances = torch.cdist(textures.flatten(1), textures.flatten(1))
    assert (distances + torch.eye(len(textures)) > 0).all()


def test_errors_are_sentences():
    with pytest.raises(ValueError, match="families are llff"):
        random_scene("nerf", 0)
    with pytest.raises(ValueError, match="Textures must be"):
        random_scene("dtu", 0, textures=torch.zeros(3, 8, 8))
    with pytest.raises(ValueError, match="families are"):
        random_cameras("nerf", 0, 2, 8, 8)
    with pytest.raises(ValueError, match="one scene"):
        random_cameras(Scene.stack([random_scene("dtu", 0)] * 2), 0, 2, 8, 8)
    with pytest.raises(ValueError, match="none|no scenes"):
        Scene.stack([])
