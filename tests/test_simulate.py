import pytest
import torch

from data_synthetic import Bead
from recon.run.exact_images import exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

# off the centre, odd and even: a swapped axis or a crop one pixel off shows
BEAD = Bead(0.8, 0.02, 1.5, (0.2, -0.35, 0.5))
GRID = Grid((32, 37, 42), (0.1, 0.13, 0.13))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2), None], [-1.0, 0.3, 1.5])


@pytest.mark.parametrize(
    ("microscope", "bound"),
    [
        (Microscope(0.546, Objective(0.8), Condenser(0.5)), 0.03),
        (Microscope(0.546, Objective(0.8), Condenser(0.4, torch.tensor([[0.3, 0.1], [0.0, -0.4]]))), 0.05),
        (Microscope(0.546, Objective(0.8)), 0.03),
    ],
    ids=["condenser", "points", "coherent"],
)
def test_the_exact_images_of_a_bead_agree_with_the_waves(microscope, bound):
    fidelity = Fidelity("wave", sources=12, padding=16)
    exact = exact_images(BEAD, GRID, microscope, ACQUISITION, fidelity)
    delta = BEAD.delta(GRID)
    with torch.no_grad():
        wave = image(Volume(GRID, delta, 1.5), microscope, ACQUISITION, fidelity)
    assert exact.shape == (3, 3, 37, 42)
    assert exact.dtype == torch.float64
    # over each prism's contrast in all planes: bright field has nearly none where it is sharp
    contrast = exact.std((2, 3)).square().mean(1, keepdim=True).sqrt()
    difference = (exact - wave).square().mean((2, 3)).sqrt() / contrast
    assert float(difference.max()) < bound
    for axis in (2, 3):
        mirrored = (exact - wave.flip(axis)).square().mean((2, 3)).sqrt() / contrast
        assert float(mirrored.min()) > 4 * bound


def test_the_exact_images_of_nothing_are_empty():
    bead = Bead(0.8, 0.0, 1.5)
    grid = Grid((4, 15, 18), (0.5, 0.15, 0.15))
    images = exact_images(
        bead, grid, Microscope(0.546, Objective(0.8), Condenser(0.5)), ACQUISITION, Fidelity(sources=6)
    )
    expected = torch.sin(torch.tensor([0.75, -0.6], dtype=torch.float64)) ** 2
    assert torch.allclose(images[:2], expected[:, None, None, None].expand(2, 3, 15, 18), atol=1e-9)
    assert torch.allclose(images[2], torch.ones(3, 15, 18, dtype=torch.float64), atol=1e-9)


def test_the_exact_images_do_not_depend_on_how_sources_are_batched():
    grid = Grid((4, 15, 18), (0.5, 0.15, 0.15))
    points = torch.rand(20, 2, dtype=torch.float64) - 0.5
    weights = torch.rand(20, dtype=torch.float64)
    together = exact_images(
        BEAD, grid, Microscope(0.546, Objective(0.8), Condenser(0.7, points, weights)), ACQUISITION, Fidelity()
    )
    alone = [
        exact_images(
            BEAD, grid, Microscope(0.546, Objective(0.8), Condenser(0.7, point[None])), ACQUISITION, Fidelity()
        )
        for point in points
    ]
    summed = sum(w * one for w, one in zip(weights / weights.sum(), alone, strict=True))
    assert torch.allclose(together, summed, rtol=0, atol=1e-12)
