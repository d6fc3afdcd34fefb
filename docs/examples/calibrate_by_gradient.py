"""Calibrate by gradient: find the lens of a panel from the image of a known scene that was drawn for it."""

from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image

import lightfield_gs as lf

data = Path(lf.__file__).parent / "data" / "banana"
scene = lf.Gaussians.load(data / "fitted.spz")[::4]
whole = lf.Rig.from_yaml(data / "fitted.rig.yaml").relative_to(scene.origin)
panel, rig = whole.reduced(lf.Panel.load("65in-8k-96v"), 240)  # the lens as its maker states it
tolerances = {"line_number": 0.004, "slant_tan": 0.0005, "phase": 0.4}  # by these numbers it is off
true = replace(panel, **{name: getattr(panel, name) + error for name, error in tolerances.items()})
options = {"views": "continuous", "output": "float32"}  # integer views jump, and have no gradients
wanted = lf.encode(scene, true, rig, **options)

optics = lf.Optics.of(panel, names=list(tolerances))
groups = [{"params": [value], "lr": tolerances[name] / 20} for name, value in optics.given().items()]
optimizer, images = torch.optim.Adam(groups), []
for _ in range(100):
    for group in groups:
        group["lr"] *= 0.98
    images.append(lf.encode(scene, panel, rig, optics=optics, **options))
    loss = (images[-1] - wanted).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
for name, value in optics.given().items():
    print(f"{name}: off by {tolerances[name]:g} before, by {abs(value.item() - getattr(true, name)):.1e} after")

differences = [4 * (image.detach() - wanted).abs() for image in (images[0], images[-1])]
picture = torch.cat([wanted, *differences], 1).clamp(0, 1)  # the image; four times the difference, before and after
Image.fromarray((picture * 255).byte().numpy()).save("calibrate_by_gradient.webp")
