"""torchdic demo: a bead whose index is known, reconstructed by three propagations."""

import argparse
import math

import torch

from data_synthetic import Bead
from recon.config.resolved import leave_resolved
from recon.config.schema import Config, VolumeSection
from recon.fit.problem import Recipe
from recon.report import figures
from recon.report.comparison import Truth, compare, table
from recon.run.exact_images import exact_images
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_no_results
from recon.run.reconstruct import RECOMMENDED
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism
from torchdic.files.stack import write_stack

BEAD = Bead(radius=2.5, contrast=0.03, background=1.56)
GRID = Grid((20, 64, 64), (0.4, 0.17, 0.17))
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
ACQUISITION = Acquisition(
    [Prism(shear, bias) for shear in ((0.0, 0.24), (0.24, 0.0)) for bias in (math.pi / 2, -math.pi / 2)],
    [float(z) for z in range(-4, 5)],
)
# The last files that it leaves.
RESULTS = ("comparison.png", "comparison.json")

# On straight and bent rays Newton's steps err more than Adam's: they take Adam's, as many as gain them something.
CONTENDERS = (
    (Fidelity("projection"), Recipe(method="adam", steps=60)),
    (Fidelity("rays", sources=16, steps=10), Recipe(method="adam", steps=40)),
    (RECOMMENDED, Recipe()),
)


def run(options: argparse.Namespace) -> None:
    """Simulate the bead's stack from its exact field, reconstruct it by each contender, and print their scores."""
    check_no_results(options.out, RESULTS, restart=options.restart)
    prepare_folder(options.out)
    print("A 5 µm bead of index 1.59 in cement of 1.56: DIC stack from its exact field …", flush=True)
    data = exact_images(BEAD, GRID, MICROSCOPE, ACQUISITION, Fidelity(sources=150)).float()
    pixel = GRID.spacing[1:]
    write_stack(options.out / "stack.ome.tif", data, pixel, 1.0)
    leave_resolved(
        Config(VolumeSection(GRID.shape, GRID.spacing, BEAD.background), MICROSCOPE, ACQUISITION), options.out
    )
    figures.save(figures.draw_stack(data, ACQUISITION.prisms, ACQUISITION.focus, pixel), options.out / "stack.png")
    delta = BEAD.delta(GRID, dtype=torch.float32)
    truth = Truth(GRID, delta, BEAD.background, inside=delta > 0.99 * BEAD.contrast)
    scores = compare(data, truth, MICROSCOPE, ACQUISITION, CONTENDERS, options.out)
    print("\n" + table(scores, BEAD.contrast))
    print(f"\nmean Δn: over the voxels wholly inside the bead. Pictures and volumes are in {options.out}/")
