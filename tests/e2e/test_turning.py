"""The scene in the report: a real browser draws it from file:// like our own rasteriser, and the page stays small."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from cat3d_core.cameras import Cameras
from cat3d_core.rays import image_rays
from cat3d_core.splats import Gaussians, render
from flows.exports.splat_files import read_splat, write_splat
from flows.media.images import read_image
from flows.reporting import turning
from tests.core.splats.scenes import gaussians
from tests.e2e.browser import chromium, until

ROOT = Path(turning.__file__).parent
SIZE = 320, 200


def scene() -> Gaussians:
    g = gaussians(400, seed=4).to(dtype=torch.float32)
    return Gaussians(g.means, g.quaternions, g.log_scales, g.logits, 2.0 * g.harmonics)


def camera() -> Cameras:
    """Two units before the origin, turned a little."""
    turn = 0.3
    pose = torch.eye(4)
    pose[:3, :3] = torch.tensor([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
    pose[:3, 3] = -2.0 * pose[:3, 2]
    k = torch.tensor([[200.0, 0, SIZE[0] / 2], [0, 200.0, SIZE[1] / 2], [0, 0, 1]])
    return Cameras(k[None], pose[None], torch.tensor([SIZE]))


@pytest.mark.slow
def test_a_browser_draws_the_splats_of_a_page_like_ours(tmp_path: Path) -> None:
    file, page, c = tmp_path / "scene.splat", tmp_path / "page.html", camera()
    write_splat(file, scene())
    pose = c.world_from_camera[0].tolist()
    cameras = [{"pose": pose, "slopes": [-0.8, 0.8, -0.5, 0.5], "colour": [1, 0, 0]}]
    rows = json.dumps({"cameras": cameras, "points": [[0, 0, 0], [0.2, 0, 0]]})
    script = (ROOT / "templates" / "scene.js").read_text()
    page.write_text(
        f"<canvas class=splats style='width:{SIZE[0]}px;height:{SIZE[1]}px' data-splats=s data-cameras=c></canvas>"
        f"<script type=text/plain id=s>{base64.b64encode(file.read_bytes()).decode()}</script>"
        f"<script type=application/json id=c>{rows}</script><script>{script}</script>"
    )
    with chromium(tmp_path / "profile", 500, 400) as browser:
        tab = browser.open(page.as_uri())
        until(lambda: tab.run("!!document.querySelector('canvas')?.scene"))
        url = tab.run(
            "(() => { const scene = document.querySelector('canvas').scene;"
            f"scene.look({json.dumps(pose)}, {SIZE[1] / 2 / 200.0}); scene.draw();"
            "return scene.canvas.toDataURL('image/png'); })()"
        )
        before = tab.run("document.querySelector('canvas').scene.turn")
        tab.drag((100, 100), (60, 10))
        until(lambda: tab.run("document.querySelector('canvas').scene.turn") != before)
        # Points are grey dots of three pixels, once they are asked for.
        grey = tab.run(
            "(() => { const scene = document.querySelector('canvas').scene, gl = scene.gl;"
            "scene.frusta = false; const grey = [false, true].map(shown => { scene.cloud = shown; scene.draw();"
            "const pixels = new Uint8Array(4 * scene.canvas.width * scene.canvas.height);"
            "gl.readPixels(0, 0, scene.canvas.width, scene.canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);"
            "let found = 0; for (let i = 0; i < pixels.length; i += 4)"
            "found += pixels[i] === 230 && pixels[i + 1] === 230 && pixels[i + 2] === 230;"
            "return found; }); return grey; })()"
        )
        assert grey[0] < 3
        assert 12 <= grey[1] - grey[0] <= 18
    (tmp_path / "drawn.png").write_bytes(base64.b64decode(url.partition(",")[2]))
    drawn = read_image(tmp_path / "drawn.png")[0][..., :3] / 255
    ours = render(read_splat(file), c, 0).image.numpy()
    error = -10 * math.log10(float(np.square(drawn - ours).mean()))
    print(f"drawn against ours: {error:.1f} dB")
    assert error > 33
    assert -10 * math.log10(float(np.square(0.5 - ours).mean())) < 20  # there is something to see


def test_a_thinned_camera_sees_what_its_pixels_saw() -> None:
    k = torch.tensor([[[100.0, 0, 81.0], [0, 100.0, 59.5], [0, 0, 1]]])
    whole = Cameras(k, torch.eye(4)[None], torch.tensor([[161, 120]]))
    part = turning.thinned(whole, 2)
    assert part.size.tolist() == [[81, 60]]
    wanted = image_rays(whole, 0).directions.view(120, 161, 3)[::2, ::2]
    torch.testing.assert_close(image_rays(part, 0).directions.view(60, 81, 3), wanted)
