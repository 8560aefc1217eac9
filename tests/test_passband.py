"""Imaging within the pupil's window and on a coarse array: to rounding what the whole array gives, gradients too."""

import math

import pytest
import torch

from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Volume,
    image,
    image_field,
)
from torchdic.imaging.coherent import coherent_images
from torchdic.imaging.passband import Passband, interpolate
from torchdic.memory import batches

WAVELENGTH, NA, N0 = 0.546, 0.75, 1.36
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.7, 0.24], [0.05, -0.74]], dtype=torch.float64)
PROJECTION = Fidelity("projection")
CONDENSER = Condenser(NA, POINTS, torch.tensor([1.0, 2.0, 0.5, 1.5], dtype=torch.float64))
STATES = Polarisation(analyser_error=0.1, analyser_extinction=1e-3)
JONES = Polarisation(pupil=JonesPupil({6: (0.2, 0.1)}, depolarisation=True))
# even, odd, prime and unequal sides; fine and coarse voxels, down to those that alias the intensity or the pupil
GRIDS = {
    "even": Grid((3, 48, 64), (0.4, 0.1, 0.08)),
    "odd": Grid((3, 45, 51), (0.4, 0.1, 0.09)),
    "prime": Grid((3, 53, 47), (0.4, 0.08, 0.1)),
    "one-axis-coarser": Grid((3, 24, 61), (0.4, 0.22, 0.06)),
    "at-the-limit": Grid((3, 24, 30), (0.4, 0.2, 0.21)),
    "below-a-bin": Grid((3, 5, 7), (0.4, 0.06, 0.05)),
    "one-row": Grid((3, 1, 60), (0.4, 0.2, 0.07)),
}
MICROSCOPES = {
    "plain": Microscope(WAVELENGTH, Objective(NA), CONDENSER),
    "pupil": Microscope(WAVELENGTH, Objective(NA, {4: 0.3, 7: -0.2}, apodisation="aplanatic"), CONDENSER),
    "no-condenser-prism": Microscope(WAVELENGTH, Objective(NA), CONDENSER, condenser_prism=False),
    "leaky": Microscope(WAVELENGTH, Objective(NA), CONDENSER, polarisation=STATES),
    "jones": Microscope(WAVELENGTH, Objective(NA), CONDENSER, polarisation=JONES),
    "camera": Microscope(WAVELENGTH, Objective(NA), CONDENSER, Camera(pixel_size=0.17)),
}


@pytest.fixture
def whole(monkeypatch):
    """Runs a function with windows and on the whole array."""

    def both(function):
        cropped = function()
        with monkeypatch.context() as patch:
            patch.setattr(Passband, "around", lambda *_: None)
            return cropped, function()

    return both


def taken(grid, microscope, focus=(0.7, -1.1), fidelity=PROJECTION):
    """A function that takes images of a rough volume, and their gradients by the volume, the shear and a focus."""
    generator = torch.Generator().manual_seed(3)
    start = 0.02 * torch.randn(grid.shape, generator=generator, dtype=torch.float64)

    def take():
        delta = start.clone().requires_grad_()
        shear = torch.tensor([0.1, 0.2], dtype=torch.float64, requires_grad=True)
        depth = torch.tensor(focus[0], dtype=torch.float64, requires_grad=True)
        acquisition = Acquisition([Prism(shear, 1.1), None], [depth, *focus[1:]])
        images = image(Volume(grid, delta, N0), microscope, acquisition, fidelity)
        weights = torch.linspace(-1, 1, images.numel(), dtype=torch.float64).reshape(images.shape)
        return images.detach(), *torch.autograd.grad((images * weights).sum(), (delta, shear, depth))

    return take


def assert_same(both):
    cropped, full = both
    for found, expected in zip(cropped, full, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * max(1.0, float(expected.abs().max())))


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning", "ignore::torchdic.errors.SamplingWarning")
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_images_and_gradients_are_those_of_the_whole_array(whole, grid):
    assert_same(whole(taken(grid, MICROSCOPES["plain"])))


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
@pytest.mark.parametrize("microscope", MICROSCOPES.values(), ids=MICROSCOPES.keys())
@pytest.mark.parametrize(
    ("propagation", "grid"),
    [
        pytest.param(way, GRIDS[name], id=f"{way}-{name}", marks=pytest.mark.slow if way == "rays" else ())
        for way in ("projection", "rays", "wave")
        for name in ("even", "prime")
    ],
)
def test_every_pupil_and_pair_of_beams_is_held(whole, grid, microscope, propagation):
    assert_same(whole(taken(grid, microscope, fidelity=Fidelity(propagation))))


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
def test_paraxial_defocus_is_held(whole):
    assert_same(whole(taken(GRIDS["odd"], MICROSCOPES["plain"], fidelity=Fidelity("projection", defocus="paraxial"))))


def test_wrap_around_is_estimated_alike(whole):
    """The line names a part of the light and a padding, neither of which windows change."""

    def warned():
        with pytest.warns(UserWarning, match="leaves the array") as caught:
            taken(GRIDS["even"], MICROSCOPES["plain"], focus=(40.0,))()
        return str(caught[0].message)

    cropped, full = whole(warned)
    assert cropped == full


def test_thin_object_is_that_of_the_whole_array_in_float32(whole, load):
    """To float32's rounding of images of about 1, which sums over 437 directions."""
    data = load("thin_dic")
    spacing = float(data["spacing"])
    grid = Grid((1, 129, 129), (1.0, spacing, spacing))
    condenser = Condenser(float(data["na_condenser"]), points=data["source_na_yx"])
    microscope = Microscope(WAVELENGTH, Objective(float(data["na_objective"])), condenser)

    def take():
        transmission = data["object_asym"].to(torch.complex64)
        acquisition = Acquisition([Prism((0.0, 0.2), 1.0), None], [0.0, 1.0])
        return image_field(transmission, grid, microscope, acquisition, background=1.33)

    cropped, full = whole(take)
    assert float((cropped - full).abs().max()) < 16 * torch.finfo(torch.float32).eps


@pytest.mark.parametrize("na", [0.02, 0.3, 0.75, 1.2])
@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS.keys())
def test_window_holds_each_frequency_of_the_aperture_once(grid, na):
    momentum = POINTS * na / NA
    frequencies = grid.frequencies(dtype=torch.float64)
    passed = Objective(na).aperture(momentum[:, :, None, None] + WAVELENGTH * frequencies)
    band = Passband.around(grid, WAVELENGTH, na, momentum)
    if band is None:  # where it would be most of the array
        across = [
            min(n, 2 * na * n * d / WAVELENGTH + 1.01) for n, d in zip(grid.shape[1:], grid.spacing[1:], strict=True)
        ]
        assert math.prod(across) > 0.6 * math.prod(grid.shape[1:])
        return
    inside = Objective(na).aperture(momentum[:, :, None, None] + WAVELENGTH * band.frequencies)
    for source in range(len(momentum)):
        indices = band.indices[source].flatten()
        assert len(indices.unique()) == len(indices)
        assert torch.equal(indices[inside[source].flatten()].sort()[0], passed[source].flatten().nonzero()[:, 0])
        assert torch.equal(band.frequencies[source].flatten(1), frequencies.flatten(1)[:, indices])


def test_fields_are_as_small_as_their_intensities_allow(monkeypatch):
    """A quarter of the voxels' size asks for a sixteenth of the pixels: no transform is larger than that."""
    sizes = []
    back = torch.fft.ifft2
    grid = Grid((1, 160, 160), (1.0, 0.04, 0.04))
    scene = torch.ones(160, 160, dtype=torch.complex128), grid, MICROSCOPES["plain"], Acquisition()
    image_field(*scene, background=N0)  # whose memory has been measured then
    monkeypatch.setattr(torch.fft, "ifft2", lambda a, **k: sizes.append(tuple(k["s"] or a.shape[-2:])) or back(a, **k))
    image_field(*scene, background=N0)
    # 2·8.79 bins across the pupil: 18, whose differences are 35
    assert sizes == [(35, 35)]


def test_no_objective_takes_no_window(monkeypatch):
    monkeypatch.setattr(Passband, "around", lambda *_: pytest.fail("nothing bounds the frequencies"))
    grid = GRIDS["even"]
    volume = Volume(grid, torch.zeros(grid.shape, dtype=torch.float64), N0)
    image(volume, Microscope(WAVELENGTH, None, CONDENSER), Acquisition(), Fidelity("projection"))


@pytest.mark.parametrize(("few", "many"), [((5, 7), (9, 8)), ((6, 8), (6, 13)), ((4, 5), (11, 5)), ((1, 1), (4, 3))])
def test_interpolation_is_exact_for_what_the_coarse_array_holds(few, many, dtype):
    """A trigonometric polynomial of the frequencies below half the coarse one's pixels."""
    generator = torch.Generator().manual_seed(1)
    terms = [(j, k) for j in range(-((few[0] - 1) // 2), (few[0] + 1) // 2) for k in range((few[1] + 1) // 2)]
    amplitudes = torch.randn(len(terms), 2, generator=generator, dtype=torch.float64)

    def sampled(shape):
        y, x = (torch.arange(n, dtype=torch.float64) / n for n in shape)
        phases = [2 * math.pi * (j * y[:, None] + k * x) for j, k in terms]
        waves = [a * p.cos() + b * p.sin() for (a, b), p in zip(amplitudes, phases, strict=True)]
        return (torch.stack(waves).sum(0) + amplitudes.abs().sum()).to(dtype)

    expected = sampled(many)
    rounding = 32 * torch.finfo(dtype).eps * float(expected.abs().max())
    torch.testing.assert_close(interpolate(sampled(few), many), expected, rtol=0, atol=rounding)


def test_dark_is_dark_on_a_coarse_array_too(dtype):
    """An empty field at extinction is exactly 0, and no intensity is below it."""
    y, x = (GRIDS["even"].coordinates(axis, dtype=dtype) for axis in (1, 2))
    bead = torch.exp(-4j * torch.exp(-8 * (y[:, None] ** 2 + x**2)))
    acquisition = Acquisition([Prism((0.1, 0.2), 0.0)], [0.0, 1.0])
    empty, seen = (
        image_field(field, GRIDS["even"], MICROSCOPES["plain"], acquisition, background=N0)
        for field in (torch.ones_like(bead), bead)
    )
    assert bool((empty == 0).all())
    assert float(seen.min()) >= 0
    assert float(seen.max()) > 0.1


def test_images_of_the_same_size_are_left_as_they_are():
    images = torch.rand(2, 3, 5, 6)
    assert interpolate(images, (5, 6)) is images


@pytest.mark.parametrize("held", [1, 1 << 20], ids=["source by source", "at once"])
@pytest.mark.parametrize("own", [True, False], ids=["transfer of each source", "transfer of all"])
def test_derivative_of_coherent_images_is_the_central_difference(monkeypatch, own, held):
    """In spectrum, defocus, weights and transfers, whatever the parts in which sources are taken."""
    monkeypatch.setattr(batches, "IN_CACHE", held)
    spectrum, defocus = (torch.randn(3, 4, 3, dtype=torch.complex128) for _ in range(2))
    transfers = torch.randn(2, 3 if own else 1, 4, 3, dtype=torch.float64)
    variables = [spectrum, defocus, torch.rand(3, dtype=torch.float64), transfers]
    for variable in variables:
        variable.requires_grad_()

    def images(S, E, w, D):
        return coherent_images(S, E, list(D), w, (5, 6))

    assert torch.autograd.gradcheck(images, variables)
