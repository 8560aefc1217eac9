"""The gradient by an optical parameter
====================================

Every parameter of the microscope may be a tensor. Here a spherical aberration (Noll term 11) and the bias of a recorded
image are found by descent along the gradient, which autograd takes through the whole model.
"""

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid, bead = Grid((16, 40, 40), (0.25, 0.18, 0.18)), Bead(1.5, 0.02, 1.335)
volume, fidelity = Volume(grid, bead.delta(grid, dtype=torch.float32), bead.background), Fidelity("wave", sources=18)


def images(aberration, bias):
    """Two focus planes of the bead."""
    microscope = Microscope(0.546, Objective(0.9, aberrations={11: aberration}), Condenser(0.5))
    return image(volume, microscope, Acquisition([Prism((0.0, 0.2), bias)], [-1.0, 1.0]), fidelity)


recorded = images(0.4, 1.2)
sought = torch.tensor([0.0, 1.6], requires_grad=True)
adam, path = torch.optim.Adam([sought], lr=0.05), []
for _ in range(60):
    path.append(sought.detach().clone())
    adam.zero_grad()
    (images(*sought) - recorded).square().mean().backward()
    adam.step()

figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
for values, name, true in zip(torch.stack(path).T, ("spherical aberration", "bias"), (0.4, 1.2), strict=True):
    (line,) = axis.plot(values, label=name)
    axis.axhline(true, color=line.get_color(), linestyle=":")
axis.set(xlabel="step", ylabel="rad (dotted: as recorded)")
axis.legend()
plt.show()
