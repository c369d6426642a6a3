"""Point clouds from depth: exact points, and what is left out."""

import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.reconstruction import Render, normals_from_depth, point_cloud


def _plane_render(cameras: Cameras, height: int, width: int, opacity: float = 1.0) -> Render:
    """A wall at z-depth 2 whose right half is 30 units away."""
    depth = torch.full((height, width), 2.0)
    depth[:, width // 2 :] = 30.0
    image = torch.rand((height, width, 3), generator=torch.Generator().manual_seed(0))
    normals = normals_from_depth(depth, image_rays(cameras, 0, width, height))
    return Render(image, depth, depth, torch.full((height, width), opacity), normals)


@pytest.fixture
def camera() -> Cameras:
    k = torch.tensor([[[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]])
    pose = torch.eye(4)[None].clone()
    pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    return Cameras(k, pose, torch.tensor([[32, 24]]))


def test_points_project_back_to_their_pixels(camera: Cameras) -> None:
    cloud = point_cloud([_plane_render(camera, 12, 16)], camera)
    assert len(cloud.points) == 12 * 8  # the far half is beyond max_depth
    torch.testing.assert_close(cloud.points[:, 2], torch.full((96,), 5.0))
    pixels, depth = camera.project(cloud.points)
    torch.testing.assert_close(depth, torch.full((1, 96), 2.0))
    torch.testing.assert_close(pixels[0, 0], torch.tensor([1.0, 1.0]))  # centre of the first coarse pixel
    torch.testing.assert_close(cloud.normals, torch.tensor([0.0, 0.0, -1.0]).expand(96, 3))


def test_fog_is_left_out_and_counts_must_agree(camera: Cameras) -> None:
    assert not len(point_cloud([_plane_render(camera, 12, 16, opacity=0.2)], camera).points)
    with pytest.raises(ValueError, match="one camera per render"):
        point_cloud([], camera)
