"""Distil features of photographs into a scene: each Gaussian learns what a network says of the pixels that show it."""

from pathlib import Path

import torch
from PIL import Image

import lightfield_gs as lf
from lightfield_gs.io.captures.capture import read_capture

data = Path(lf.__file__).parent / "data" / "banana"
scene = lf.Gaussians.load(data / "fitted.spz")
capture = read_capture(data, longest_px=188)
pose, optics = (torch.from_numpy(values).float() for values in (capture.world_to_camera, capture.intrinsics))
cameras = lf.Cameras(pose, optics[:, :2], optics[:, 2:], *map(int, capture.sizes_px[0])).relative_to(scene.origin)
photos = torch.stack([torch.from_numpy(capture.image(n)) for n in range(len(cameras))]) / 255


def teacher(images: torch.Tensor) -> torch.Tensor:
    """Return features [C, H, W, 2]: yellow or not. Take the feature maps of your network here, of any width."""
    yellow = torch.sigmoid(30 * (images[..., :2].mean(-1) - images[..., 2] - 0.25))
    return torch.stack([yellow, 1 - yellow], -1)


held_out, wanted = 7, teacher(photos)
features = torch.zeros(scene.count, wanted.shape[-1], requires_grad=True)
optimizer = torch.optim.Adam([features], lr=0.1)
for step in range(60):
    view = [n for n in range(len(cameras)) if n != held_out][step % (len(cameras) - 1)]
    seen = lf.render(scene, cameras[view], features=features).features[0]
    loss = (seen - wanted[view]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

with torch.no_grad():
    seen = lf.render(scene, cameras[held_out], features=features).features[0]
    found, true = seen[..., 0] > seen[..., 1], wanted[held_out, ..., 0] > 0.5
    print(f"held-out photograph: intersection over union {float((found & true).sum() / (found | true).sum()):.3f}")
    fruit = lf.render(scene[features[:, 0] > features[:, 1]], cameras[held_out]).image[0].clamp(0, 1)
views = [photos[held_out], seen[..., :1].expand(-1, -1, 3).clamp(0, 1), fruit]
Image.fromarray((torch.cat(views, 1) * 255).byte().numpy()).save("distil_features.webp")
