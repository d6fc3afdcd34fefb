"""Control the density by a strategy of one's own: the faintest Gaussians move to where the picture is most wrong."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

import lightfield_gs as lf
from lightfield_gs.fitting import take_rows
from lightfield_gs.gsplat import rasterization

SIZE, DEPTH, COUNT, MOVED = 128, 3.0, 400, 40  # the focal length is SIZE too
with Image.open(Path(lf.__file__).parent / "data" / "cat.png") as photo:
    pixels = torch.from_numpy(np.array(photo.convert("RGBA").resize((SIZE, SIZE)))) / 255
target = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]  # over white


def move(params: dict, optimizers: dict, errors: torch.Tensor) -> None:
    """Make small Gaussians of the faintest ones, at pixels that are drawn by their errors [H, W]."""
    chosen = torch.multinomial(errors.flatten(), MOVED)
    places = torch.stack([chosen % SIZE, chosen // SIZE, torch.full_like(chosen, SIZE)], 1) + 0.5
    means = (places - torch.tensor([SIZE / 2, SIZE / 2, 0.5])) * DEPTH / SIZE
    new = {"means": means, "colors": target.reshape(-1, 3)[chosen]}
    new |= {"scales": torch.full((MOVED, 3), -4.0), "opacities": torch.zeros(MOVED)}
    faintest_first, is_new = params["opacities"].argsort(), torch.arange(COUNT) < MOVED
    mixed = lambda name, rows: torch.cat([new.get(name, rows[:MOVED]), rows[MOVED:]])
    take_rows(params, optimizers, faintest_first, is_new, mixed)  # Adam's moments go with the rows


def fit(moves: bool) -> torch.Tensor:
    torch.manual_seed(0)
    means = (torch.rand(COUNT, 3) - 0.5) * DEPTH + torch.tensor([0, 0, DEPTH])
    values = {"means": means, "quats": torch.randn(COUNT, 4), "colors": torch.rand(COUNT, 3)}
    values |= {"scales": torch.full((COUNT, 3), -3.0), "opacities": torch.zeros(COUNT)}  # logarithms and logits
    params = {name: torch.nn.Parameter(value) for name, value in values.items()}
    optimizers = {name: torch.optim.Adam([param], lr=0.02) for name, param in params.items()}
    K = torch.tensor([[[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]]])
    for step in range(300):
        shape = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
        camera = torch.eye(4)[None], K, SIZE, SIZE
        images, _, _ = rasterization(*shape, params["colors"], *camera, backgrounds=torch.ones(1, 3))
        errors = (images[0] - target).square().mean(-1)
        errors.mean().backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        if moves and 0 < step <= 240 and step % 20 == 0:
            move(params, optimizers, errors.detach())
    print(f"{'moved' if moves else 'as begun'}: {-10 * errors.mean().log10():.2f} dB")
    return images[0].detach().clamp(0, 1)


views = torch.cat(
    [target, fit(moves=False), fit(moves=True)], 1
)  # the photo, and the fits without and with the strategy
Image.fromarray((views * 255).byte().numpy()).save("own_density.webp")
