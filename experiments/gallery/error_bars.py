"""Error bars
==========

How far off is a volume? Its own images with other noise are fitted again: how its voxels scatter is their bar by noise.
And turned copies of it, whose truth is known, are recorded and fitted. Their errors tell the whole bar, which is widest
at surfaces and holds the truth of two in three of all voxels in and near the specimen, by no means of each.
"""

import matplotlib.pyplot as plt
import torch

from data_synthetic import Ellipsoid
from recon import NoiseModel, Problem, Recipe, Setup, empty_medium, error_bars
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid, photons = Grid((14, 40, 40), (0.4, 0.17, 0.17)), 2000
truth = 0.02 * Ellipsoid((1.4, 1.2, 2.0), (0.3, 0.2, -0.2)).fill(grid).float()
prisms = [Prism((0.0, 0.2), torch.pi / 2), Prism((0.2, 0.0), torch.pi / 2)]
scene = Microscope(0.546, Objective(0.9), Condenser(0.7)), Acquisition(prisms, [-2.0, -1.0, 0.0, 1.0, 2.0])
noiseless = image(Volume(grid, truth, 1.335), *scene, Fidelity(sources=128))
data = Camera(photons=photons).record(noiseless, torch.Generator().manual_seed(0))
problem = Problem.from_recipe(data, Setup(empty_medium(grid, 1.335, data), *scene), Fidelity(sources=50), Recipe())
bars = error_bars(problem, noise=NoiseModel(gain=1 / photons, read=0.0), noisy=8, copies=4)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
for axis, at, name, line in ((axes[0], 2, "x", (7, 21)), (axes[1], 0, "z", (slice(None), 21, 19))):
    place = grid.coordinates(at)
    axis.step(place, truth[line], where="mid", color="black", label="truth")
    axis.errorbar(place, bars.delta[line], bars.total[line], fmt="C0.", label="found, with its whole bar")
    axis.errorbar(place, bars.delta[line], bars.deviation[line], fmt="C1", linestyle="", linewidth=4, label="by noise")
    axis.set(xlabel=f"{name}, µm", ylabel="Δn", title=f"a line along {name}")
axes[0].legend(loc="center")
plt.show()
