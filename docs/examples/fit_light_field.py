"""Fit Gaussians to the image of a panel: every sub-pixel is one sample of the light field, and has gradients."""

from pathlib import Path

import torch
from PIL import Image

import lightfield_gs as lf

data = Path(lf.__file__).parent / "data" / "banana"
scene = lf.Gaussians.load(data / "fitted.spz")
whole = lf.Rig.from_yaml(data / "fitted.rig.yaml").relative_to(scene.origin)
panel, rig = whole.reduced(lf.Panel.load("65in-8k-96v"), 200)  # of 200 x 100 pixels, so that a step is short
target = lf.encode(scene, panel, rig, output="float32")

few = scene[::20]  # one of twenty, grey and larger: where the fit begins
few = lf.Gaussians(few.means, few.quaternions, few.scales * 3, few.opacities, torch.zeros_like(few.sh))
start = {"means": few.means, "quaternions": few.quaternions, "scales": few.scales.log()}
start |= {"opacities": few.opacities.clamp(0.1, 0.9).logit(), "sh": few.sh}
rates = {"means": 2e-3, "quaternions": 2e-3, "scales": 2e-2, "opacities": 3e-2, "sh": 2e-2}
fitted = {name: value.clone().requires_grad_() for name, value in start.items()}
optimizer = torch.optim.Adam([{"params": [fitted[name]], "lr": rate} for name, rate in rates.items()])


def gaussians() -> lf.Gaussians:
    return lf.Gaussians(**{**fitted, "scales": fitted["scales"].exp(), "opacities": fitted["opacities"].sigmoid()})


for step in range(101):
    image = lf.encode(gaussians(), panel, rig, output="float32")
    loss = (image - target).square().mean()
    if step % 25 == 0:
        print(f"step {step}: {-10 * loss.log10():.2f} dB")
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

larger, rig = whole.reduced(lf.Panel.load("65in-8k-96v"), 300)
with torch.no_grad():  # the view in the middle: of the scene, of the Gaussians where the fit began, and of the fit
    camera = rig.cameras(larger, [48]).to(torch.float32)
    views = [lf.render(one, camera).image[0].clamp(0, 1) for one in (scene, few, gaussians())]
Image.fromarray((torch.cat(views, 1) * 255).byte().numpy()).save("fit_light_field.webp")
