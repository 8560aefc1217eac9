"""Laws that hold for every microscope: what an image must be whatever the way it is computed."""

import cmath
import math
from dataclasses import replace

import pytest
import torch
from through import propagate

from data_synthetic import GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field

WAVELENGTH = 0.546
N0 = 1.36
POINTS = torch.tensor([[0.0, 0.0], [0.3, -0.1], [-0.15, 0.35], [0.05, 0.22]], dtype=torch.float64)
SIZES = [(4, 11, 14), (3, 8, 8), (1, 9, 7), (5, 16, 1), (2, 1, 12), (1, 1, 1), (6, 10, 33)]


def eps(dtype):
    return torch.finfo(dtype).eps


def partially_coherent(points=POINTS, na=0.75):
    return Microscope(WAVELENGTH, Objective(na), Condenser(0.4, points=points))


def off_centre_ball(grid, contrast=0.02, sigma=0.6, centre=(0.3, -0.35, 0.5), dtype=torch.float64):
    return Volume(grid, GaussianBall(sigma, contrast, N0, centre).delta(grid, dtype), N0)


# --- the empty field -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("objective", [None, Objective(0.75, {4: 0.3, 8: -0.2})], ids=["no-pupil", "aberrated"])
@pytest.mark.parametrize("condenser", [None, Condenser(0.4)], ids=["axial", "partially-coherent"])
def test_empty_field_is_sin2_half_bias(small, propagation, dtype, objective, condenser):
    biases = [0.0, 0.4, math.pi / 2, -1.9, math.pi, 5.0]
    microscope = Microscope(WAVELENGTH, objective, condenser)
    acquisition = Acquisition([Prism((0.13, 0.2), b) for b in biases], [0.0, 2.5, -1.0])
    volume = Volume(small, torch.zeros(small.shape, dtype=dtype), N0)
    images = image(volume, microscope, acquisition, Fidelity(propagation, sources=16))
    assert images.dtype == dtype
    assert images.shape == (6, 3, 11, 14)
    expected = torch.tensor([math.sin(b / 2) ** 2 for b in biases], dtype=dtype)
    # a few FFTs of a constant and a sum over sources: some roundings
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=16 * eps(dtype))


@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_empty_brightfield_is_one_and_empty_dic_is_sin2_half_bias_for_any_size(shape, propagation):
    grid = Grid(shape, (0.5, 0.2, 0.21))
    volume = Volume(grid, torch.zeros(shape, dtype=torch.float64), N0)
    acquisition = Acquisition([None, Prism((0.1, -0.2), 1.1)], [0.7])
    images = image(volume, partially_coherent(), acquisition, Fidelity(propagation))
    assert images.shape == (2, 1, *shape[1:])
    expected = torch.tensor([1.0, math.sin(0.55) ** 2], dtype=torch.float64)
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=1e-14)


def test_dark_field_directions_add_nothing_to_the_empty_field(small, propagation):
    """Two of five equal weights lie outside the objective's NA: the empty bright field is 3/5, not 1."""
    points = torch.cat((POINTS[:3], torch.tensor([[0.6, 0.7], [-0.8, 0.1]], dtype=torch.float64)))
    microscope = Microscope(WAVELENGTH, Objective(0.75), Condenser(0.95, points=points))
    volume = Volume(small, torch.zeros(small.shape, dtype=torch.float64), N0)
    fidelity = Fidelity(propagation)
    with pytest.warns(UserWarning, match="coarser"):
        images = image(volume, microscope, Acquisition([None, Prism((0.0, 0.2), 1.0)]), fidelity)
    torch.testing.assert_close(images[0], torch.full_like(images[0], 0.6), rtol=0, atol=1e-14)
    torch.testing.assert_close(images[1], torch.full_like(images[0], 0.6 * math.sin(0.5) ** 2), rtol=0, atol=1e-14)


def test_dark_field_light_reaches_the_image_by_scattering_alone(propagation):
    """All light outside the objective's NA: black where nothing scatters, bright where a specimen does."""
    grid = Grid((6, 48, 48), (0.4, 0.16, 0.16))
    points = torch.tensor([[0.0, 0.62], [0.0, -0.62]], dtype=torch.float64)
    microscope = Microscope(WAVELENGTH, Objective(0.6), Condenser(0.62, points=points))
    volume = off_centre_ball(grid, contrast=0.02, sigma=0.4)
    images = image(volume, microscope, Acquisition(), Fidelity(propagation))[0, 0]
    peak = divmod(int(images.argmax()), 48)
    centre = (grid.index(1, -0.35), grid.index(2, 0.5))
    assert math.dist(peak, centre) < 3
    assert float(images.max()) > 100 * float(images[0].max())
    assert float(images[0].max()) < 1e-4


# --- the two beams -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shear", [(0.4, 0.0), (0.0, 0.6), (-0.8, 0.2)])
@pytest.mark.parametrize("bias", [0.7, -2.0])
def test_coherent_dic_of_a_phase_object_is_sin2_of_half_bias_and_half_phase_difference(shear, bias):
    """Without a pupil and for axial light I = sin²(bias/2 + ½[φ(x + s/2) − φ(x − s/2)]) exactly, on whole pixels."""
    grid = Grid((1, 24, 30), (1.0, 0.2, 0.1))
    y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    phase = 0.8 * torch.exp(-((y - 0.3) ** 2) / 0.5 - (x + 0.2) ** 2 / 0.3 + 0.3 * y * x)
    shift = [round(s / d / 2) for s, d in zip(shear, grid.spacing[1:], strict=True)]
    ahead = phase.roll((-shift[0], -shift[1]), (0, 1))
    behind = phase.roll(shift, (0, 1))
    expected = torch.sin(bias / 2 + (ahead - behind) / 2) ** 2
    # wavelength 0.2: all of the array's frequencies propagate, up to √(2.5² + 5²) < 1.36/0.2
    images = image_field(
        torch.polar(torch.ones_like(phase), phase),
        grid,
        Microscope(0.2),
        Acquisition([Prism(shear, bias)]),
        background=N0,
    )
    torch.testing.assert_close(images[0, 0], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("axis", [0, 1], ids=["y", "x"])
def test_positive_shear_and_bias_brighten_rising_opd(propagation, axis):
    """Where the OPD rises along +s it is brighter than the empty field, where it falls darker; not so across s."""
    grid = Grid((8, 48, 50), (0.3, 0.16, 0.15))
    volume = off_centre_ball(grid)
    shear = (0.2, 0.0) if axis == 0 else (0.0, 0.2)
    for bias in (0.4, math.pi / 2, 2.6):
        images = image(volume, partially_coherent(), Acquisition([Prism(shear, bias)], [0.3]), Fidelity(propagation))
        rows, columns = (grid.index(a, c) for a, c in ((1, -0.35), (2, 0.5)))
        centre, step = [round(rows), round(columns)], 0.6 / grid.spacing[axis + 1]
        before, after = centre.copy(), centre.copy()
        before[axis] -= round(step)
        after[axis] += round(step)
        empty = math.sin(bias / 2) ** 2
        # OPD rises towards the ball's centre from below, so the side before it along +s is the bright one
        assert float(images[0, 0, *before]) > empty + 0.01
        assert float(images[0, 0, *after]) < empty - 0.01


@pytest.mark.parametrize("bias", [*(pytest.param(b, marks=pytest.mark.slow) for b in (0.5, math.pi / 2)), -1.2])
def test_weak_phase_image_is_sin2_of_half_bias_and_half_shear_times_gradient(propagation, bias):
    """I ≈ sin²(bias/2 + ½ s·∇φ), φ = k0 ∫Δn dz: for a gentle specimen to 2 % of the contrast."""
    grid = Grid((11, 64, 60), (0.6, 0.2, 0.22))
    sigma, contrast, (_, cy, cx) = 1.5, 0.001, (centre := (0.0, -0.4, 0.7))
    ball = GaussianBall(sigma, contrast, N0, centre)
    shear = (0.12, -0.2)
    volume = Volume(grid, ball.delta(grid), N0)
    microscope = Microscope(WAVELENGTH, Objective(0.75), Condenser(0.1))
    acquisition = Acquisition([Prism(shear, bias)])
    found = image(volume, microscope, acquisition, Fidelity(propagation, sources=10))[0, 0]
    y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    position = torch.stack((y, x), -1)
    opd = ball.straight_opd(position, torch.zeros_like(position), start=-3.3, end=3.3)
    slope = -(shear[0] * (y - cy) + shear[1] * (x - cx)) / sigma**2
    expected = torch.sin(bias / 2 + math.pi / WAVELENGTH * opd * slope) ** 2
    contrast_ = float((expected - math.sin(bias / 2) ** 2).abs().max())
    assert float((found - expected).abs().max()) < 0.02 * contrast_


def test_opposite_shear_and_opposite_bias_give_the_same_image_exactly(small, propagation, dtype, smooth_field):
    volume = Volume(small, smooth_field(small, 0.03, dtype), N0)
    prisms = [Prism((0.07, 0.2), -0.9), Prism((-0.07, -0.2), 0.9), Prism((0.07, 0.2), 0.9)]
    one, same, other = image(volume, partially_coherent(), Acquisition(prisms, [0.4]), Fidelity(propagation))
    assert torch.equal(one, same)
    assert float((one - other).abs().max()) > 0.01


def test_shear_of_zero_is_brightfield_times_sin2_half_bias(small, propagation, smooth_field):
    volume = Volume(small, smooth_field(small, 0.03), N0)
    images = image(volume, partially_coherent(), Acquisition([Prism((0.0, 0.0), 1.3), None]), Fidelity(propagation))
    torch.testing.assert_close(images[0], math.sin(0.65) ** 2 * images[1], rtol=0, atol=1e-14)


def test_phase_object_is_invisible_in_the_coherent_bright_field_without_a_pupil(smooth_field):
    """|exp(iφ)|² = 1: bright field shows a phase only through a pupil or out of focus."""
    grid = Grid((1, 18, 21), (1.0, 0.3, 0.3))
    transmission = torch.polar(torch.ones(18, 21, dtype=torch.float64), smooth_field(grid, 1.0)[0])
    sharp, blurred = image_field(
        transmission, grid, Microscope(WAVELENGTH), Acquisition(focus=[0.0, 1.0]), background=1.5
    )[0]
    # the sharpest frequency propagates: 1/0.6·√2 = 2.36 < 1.5/0.546 = 2.75 per µm
    torch.testing.assert_close(sharp, torch.ones_like(sharp), rtol=0, atol=1e-13)
    assert float((blurred - 1).abs().max()) > 0.1


# --- agreement of the propagations ---------------------------------------------------------------------------------


def test_bending_vanishes_with_contrast():
    """Bent and straight rays differ in W to second order of Δn: a tenth of it, a hundredth of the difference."""
    grid = Grid((17, 24, 26), (0.4, 0.2, 0.2))
    momentum = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    differences = []
    for contrast in (0.02, 0.002):
        volume = off_centre_ball(grid, contrast, sigma=0.8)
        fields = [
            propagate(volume, 10.0, momentum, 0.4, Fidelity(p, interpolation="cubic", amplitude=False, steps=68))
            for p in ("rays", "projection")
        ]
        # so long a wavelength that the envelopes' difference is that of 2πW/λ
        differences.append(float((fields[0] - fields[1]).abs().max()))
    assert math.log10(differences[0] / differences[1]) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("other", ["rays", "wave"])
def test_images_agree_as_contrast_vanishes(other):
    """Differences of the images fall with Δn, and are a small part of the contrast at any weak Δn."""
    grid = Grid((8, 40, 44), (0.35, 0.2, 0.2))
    acquisition = Acquisition([Prism((0.1, 0.18), 1.2)], [0.3])
    found = []
    for contrast in (4e-3, 4e-4):
        volume = off_centre_ball(grid, contrast, sigma=0.7, centre=(0.175, -0.35, 0.5))
        straight, other_ = (
            image(volume, partially_coherent(), acquisition, Fidelity(p, interpolation="cubic"))
            for p in ("projection", other)
        )
        signal = float((straight - math.sin(0.6) ** 2).abs().max())
        found.append(float((straight - other_).abs().max()))
        # what is left at any contrast is diffraction within the specimen's depth: its width is 1.3 wavelengths
        assert found[-1] < 0.05 * signal
    assert found[1] < 0.11 * found[0]


def test_rays_and_wave_agree_on_a_smooth_specimen_better_than_straight_rays():
    grid = Grid((16, 48, 48), (0.4, 0.2, 0.2))
    volume = off_centre_ball(grid, 0.03, sigma=1.2, centre=(0.2, -0.3, 0.4))
    acquisition = Acquisition([Prism((0.1, 0.2), 1.2)], [-1.0, 1.0])
    straight, bent, wave = (
        image(volume, partially_coherent(), acquisition, Fidelity(p)) for p in ("projection", "rays", "wave")
    )
    assert float((bent - wave).norm()) < 0.25 * float((straight - wave).norm())


@pytest.mark.parametrize("delta", [0.04, -0.03])
@pytest.mark.parametrize("direction", [(0.0, 0.0), (0.5, -0.4), (-0.2, 0.7)], ids=str)
def test_slab_retards_oblique_light_by_its_thickness_times_the_difference_of_axial_momenta(
    propagation, dtype, delta, direction
):
    """W = thickness·(√(n² − |p0|²) − √(n0² − |p0|²)), exactly: one wave in, one wave out."""
    grid = Grid((5, 8, 9), (0.7, 0.3, 0.3))
    volume = Volume(grid, torch.full(grid.shape, delta, dtype=dtype), N0)
    momentum = torch.tensor([direction], dtype=dtype)
    spectrum = propagate(volume, WAVELENGTH, momentum, 0.0, Fidelity(propagation))
    p2 = sum(c**2 for c in direction)
    opd = 3.5 * (math.sqrt((N0 + delta) ** 2 - p2) - math.sqrt(N0**2 - p2))
    expected = torch.zeros_like(spectrum)
    expected[0, 0, 0] = cmath.exp(2j * math.pi / WAVELENGTH * opd)
    # delta itself is rounded, to a part in 1/eps of the index
    k_thickness = 2 * math.pi / WAVELENGTH * 3.5
    torch.testing.assert_close(spectrum, expected, rtol=0, atol=(1 + k_thickness) * 8 * eps(dtype))


@pytest.mark.parametrize("delta", [0.0, 0.05])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_slab_absorbs_exactly_exp_minus_two_k0_kappa_thickness(propagation, delta, interpolation):
    grid = Grid((6, 8, 9), (0.3, 0.2, 0.2))
    kappa = torch.linspace(0.002, 0.03, 6, dtype=torch.float64)[:, None, None].expand(grid.shape)
    volume = Volume(grid, torch.full(grid.shape, delta, dtype=torch.float64), N0, kappa)
    for order in (1, 2):
        fidelity = Fidelity(propagation, interpolation=interpolation, steps=6, order=order)
        images = image(volume, Microscope(WAVELENGTH, Objective(0.7)), Acquisition([None]), fidelity)
        transmitted = math.exp(-4 * math.pi / WAVELENGTH * float(kappa[:, 0, 0].sum()) * 0.3)
        assert transmitted < 0.6
        # RK4 is Simpson's rule over the kinks of κ's linear interpolation, at which it errs in third order
        tolerance = 1e-3 if propagation == "rays" else 1e-12
        torch.testing.assert_close(images, torch.full_like(images, transmitted), rtol=tolerance, atol=0)


# --- focus ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [-1.2, 0.8])
def test_focus_makes_its_plane_sharp(propagation, depth):
    """The shadow of a small bead at depth z is deepest at focus z, not at −z or between.

    Images of opposite bias differ by the phase's slope alone, which defocus only blurs.
    """
    grid = Grid((15, 48, 48), (0.4, 0.18, 0.18))
    volume = off_centre_ball(grid, 0.01, sigma=0.25, centre=(depth, 0.4, -0.3))
    focus = [-2.4, 0.8, -1.2, 2.0, 0.0, 0.4, -0.8, 1.2, -1.6, -0.4]
    images = image(
        volume,
        partially_coherent(na=0.9),
        Acquisition([Prism((0.0, 0.15), b) for b in (1.2, -1.2)], focus),
        Fidelity(propagation),
    )
    assert focus[int((images[0] - images[1]).std((-1, -2)).argmax())] == depth


def test_small_absorber_is_darkest_in_focus():
    grid = Grid((11, 48, 48), (0.4, 0.18, 0.18))
    absorption = GaussianBall(0.2, 0.01, N0, (0.8, 0.36, -0.18)).delta(grid)
    volume = Volume(grid, torch.zeros_like(absorption), N0, absorption)
    focus = [0.0, 1.6, 0.4, 0.8, -0.8, 1.2]
    images = image(volume, partially_coherent(na=0.9), Acquisition(focus=focus), Fidelity("wave"))
    assert focus[int(images[0].amin((-1, -2)).argmin())] == 0.8


def test_focus_planes_and_prisms_are_independent_of_their_order_and_company(small, propagation, smooth_field):
    volume = Volume(small, smooth_field(small, 0.03), N0)
    prisms, focus = [Prism((0.07, 0.2), -0.9), None, Prism((0.1, -0.1), 0.5)], [0.8, -0.6, 0.1]
    images = image(volume, partially_coherent(), Acquisition(prisms, focus), Fidelity(propagation))
    for i, prism in enumerate(prisms):
        for j, z in enumerate(focus):
            alone = image(volume, partially_coherent(), Acquisition([prism], [z]), Fidelity(propagation))
            assert torch.equal(alone[0, 0], images[i, j])


# --- symmetries ----------------------------------------------------------------------------------------------------


def transposed(volume):
    grid = volume.grid
    grid = Grid(*((v[0], v[2], v[1]) for v in (grid.shape, grid.spacing)))
    absorption = None if volume.absorption is None else volume.absorption.transpose(1, 2)
    return Volume(grid, volume.delta.transpose(1, 2), volume.background, absorption)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_swapping_y_and_x_of_everything_transposes_the_image(propagation, smooth_field, interpolation):
    grid = Grid((4, 11, 14), (0.5, 0.2, 0.22))
    volume = Volume(grid, smooth_field(grid, 0.03), N0, 0.003 * smooth_field(grid, seed=1).abs())
    shears, focus = [(0.07, 0.2), (-0.15, 0.05)], [0.6, -0.8]
    fidelity = Fidelity(propagation, interpolation=interpolation)

    def images(volume, points, shears):
        return image(volume, partially_coherent(points), Acquisition([Prism(s, 0.9) for s in shears], focus), fidelity)

    one = images(volume, POINTS, shears)
    other = images(transposed(volume), POINTS.flip(1), [s[::-1] for s in shears])
    assert float((one[..., :11, :11] - one[..., :11, :11].transpose(-1, -2)).abs().max()) > 0.05
    torch.testing.assert_close(other.transpose(-1, -2), one, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axes", [(1,), (2,), (1, 2)], ids=["y", "x", "both"])
def test_mirroring_everything_mirrors_the_image(propagation, smooth_field, axes):
    # odd sizes: an even one holds the Nyquist frequency with one sign only, which tilted light is not alike in
    grid = Grid((4, 11, 15), (0.5, 0.2, 0.22))
    delta = smooth_field(grid, 0.02)
    sign = torch.tensor([-1.0 if a in axes else 1.0 for a in (1, 2)], dtype=torch.float64)
    shear = torch.tensor([0.07, 0.2], dtype=torch.float64)

    def images(delta, points, shear):
        acquisition = Acquisition([Prism(shear, 0.9)], [0.6, -0.8])
        return image(Volume(grid, delta, N0), partially_coherent(points), acquisition, Fidelity(propagation))

    one, other = images(delta, POINTS, shear), images(delta.flip(axes), POINTS * sign, shear * sign)
    assert float((one - one.flip([a + 1 for a in axes])).abs().max()) > 0.1
    # the diagonals of the ray mesh lean to one side: its interpolation is of third order, not symmetric
    tolerance = 1e-3 if propagation == "rays" and len(axes) == 1 else 1e-12
    torch.testing.assert_close(other.flip([a + 1 for a in axes]), one, rtol=0, atol=tolerance)


def turned(vectors, angle):
    """Transverse vectors (…, 2), (y, x), turned from x towards y."""
    y, x = vectors.unbind(-1)
    return torch.stack((y * math.cos(angle) + x * math.sin(angle), x * math.cos(angle) - y * math.sin(angle)), -1)


def at(images, grid, places):
    """Images (…, y, x) at places (place, 2) in µm, by their Fourier series: exact for what the array holds."""
    waves = [
        torch.exp(2j * math.pi * (p - grid.centre(axis, 0))[:, None] * torch.fft.fftfreq(n, d, dtype=torch.float64))
        for axis, p, n, d in zip((1, 2), places.unbind(-1), grid.shape[1:], grid.spacing[1:], strict=True)
    ]
    return torch.einsum("...yx,py,px->...p", torch.fft.fft2(images, norm="forward"), *waves).real


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_turning_everything_by_30_degrees_turns_the_image(propagation):
    """Specimen, shear and sources turned together about the optical axis, by an angle that the voxels don't share.

    The smooth specimen is written down anew on the same voxels, and the image read at the turned places. What is left
    is of the voxels and of the square array.
    """
    grid = Grid((10, 64, 64), (0.5, 0.16, 0.16))
    angle, shear = math.radians(30), torch.tensor([0.05, 0.22], dtype=torch.float64)
    z, y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in range(3)), indexing="ij")

    def images(specimen_angle, shear_angle):
        v, u = turned(torch.stack((y, x), -1), -specimen_angle).unbind(-1)
        delta = 0.02 * torch.exp(-(z**2) / 1.3 - (v - 0.3) ** 2 / 0.9 - (u + 0.2) ** 2 / 2.2)
        scope = partially_coherent(turned(POINTS, specimen_angle))
        acquisition = Acquisition([Prism(turned(shear, shear_angle), 0.9)], [0.8])
        return image(Volume(grid, delta, N0), scope, acquisition, Fidelity(propagation, interpolation="cubic"))[0, 0]

    places = torch.stack((y[0], x[0]), -1).flatten(0, 1)
    places = places[places.norm(dim=-1) < 3]
    straight = at(images(0.0, 0.0), grid, places)
    contrast = float(straight.std())
    error = {
        shear_angle: float(
            (at(images(angle, shear_angle), grid, turned(places, angle)) - straight).square().mean().sqrt()
        )
        for shear_angle in (angle, 0.0, -angle)
    }
    assert error[angle] < 0.002 * contrast, error[angle] / contrast
    assert min(error[0.0], error[-angle]) > 0.2 * contrast


@pytest.mark.parametrize("shift", [(3, 0), (0, -4), (2, 5)])
def test_shifting_the_specimen_by_whole_pixels_shifts_the_image(propagation, shift):
    """Where the specimen is away from the sides; for the wave, periodic in the array, across them too."""
    grid = Grid((4, 40, 42), (0.5, 0.2, 0.22))
    delta = off_centre_ball(grid, sigma=0.35).delta
    delta = torch.where(delta > 1e-9, delta, 0)
    if propagation == "wave":
        delta = delta.roll((15, 15), (1, 2))
    acquisition = Acquisition([Prism((0.07, 0.2), 0.9)], [0.6])

    def of(delta):
        return image(Volume(grid, delta, N0), partially_coherent(), acquisition, Fidelity(propagation))

    torch.testing.assert_close(of(delta.roll(shift, (1, 2))), of(delta).roll(shift, (2, 3)), rtol=0, atol=1e-11)


def test_reversing_the_optical_axis_of_a_symmetric_setup_leaves_a_weak_image_mirrored_in_focus(propagation):
    """Weak specimens: light through z-mirrored Δn at focus −z is light through Δn at focus z, of conjugate phase."""
    grid = Grid((9, 40, 40), (0.4, 0.2, 0.2))
    ball = GaussianBall(0.5, 1e-4, N0, (0.8, 0.4, -0.2))
    points = torch.cat((POINTS, -POINTS[1:]))
    up = image(
        Volume(grid, ball.delta(grid), N0), partially_coherent(points), Acquisition(focus=[0.5]), Fidelity(propagation)
    )
    down = image(
        Volume(grid, -ball.delta(grid).flip(0), N0),
        partially_coherent(points),
        Acquisition(focus=[-0.5]),
        Fidelity(propagation),
    )
    signal = float((up - 1).abs().max())
    assert float((up - down).abs().max()) < 0.02 * signal


def test_shear_planes_and_the_sign_of_delta_n_reversed_together_are_a_gauge_and_no_two_of_them_are(propagation):
    """To first order in Δn; the bias reversed is the shear reversed, exactly."""
    grid = Grid((7, 32, 30), (0.4, 0.2, 0.2))
    delta = GaussianBall(0.5, 1e-4, N0, (0.8, 0.4, -0.2)).delta(grid)
    microscope = partially_coherent(torch.cat((POINTS, -POINTS[1:])))
    focus = (-1.5, -0.5, 0.5, 1.5)

    def of(sign, planes, shear=1, bias=1):
        prisms = [Prism((0.0, shear * 0.24), bias * 1.2), Prism((shear * 0.24, 0.0), bias * 1.2)]
        volume = Volume(grid, sign * (delta if planes > 0 else delta.flip(0)), N0)
        return image(volume, microscope, Acquisition(prisms, focus[::planes]), Fidelity(propagation))

    images = of(1, 1)
    contrast = (images - math.sin(0.6) ** 2).norm()
    assert (of(-1, -1, shear=-1) - images).norm() < 0.02 * contrast
    torch.testing.assert_close(of(-1, -1, bias=-1), of(-1, -1, shear=-1), rtol=0, atol=1e-12)
    for fewer in ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)):
        assert (of(*fewer) - images).norm() > 0.5 * contrast, fewer


# --- voxels --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("propagation", "fine", "tolerance"),
    [
        pytest.param(
            propagation,
            fine,
            tolerance,
            id=f"{propagation}-{fine}-{tolerance}",
            marks=pytest.mark.slow if fine == (3, 3, 3) or (propagation == "rays" and fine == (1, 3, 3)) else (),
        )
        for propagation in ("projection", "rays", "wave")
        for fine, tolerance in (((3, 1, 1), 0.01), ((1, 3, 3), 0.02), ((3, 3, 3), 0.02))
    ],
)
def test_index_does_not_depend_on_voxel_size(propagation, fine, tolerance):
    """A third of the voxel size along z, along y and x, or all: the same image at the shared centres.

    Relative to the contrast the difference is of second order in the voxel size over the specimen's width.
    """
    coarse = Grid((9, 32, 30), (0.5, 0.24, 0.24))
    grid = Grid(
        *(
            tuple(f(n, k) for n, k in zip(v, fine, strict=True))
            for f, v in ((int.__mul__, coarse.shape), (float.__truediv__, coarse.spacing))
        )
    )
    assert grid.extent == pytest.approx(coarse.extent)
    microscope = Microscope(0.7, Objective(0.75), Condenser(0.4, points=POINTS))
    images = [
        image(
            off_centre_ball(g, 0.02, sigma=0.8, centre=(0.0, -0.35, 0.5)),
            microscope,
            Acquisition([Prism((0.1, 0.2), 1.0)], [0.5]),
            Fidelity(propagation, interpolation="cubic", reference_plane=0.0),
        )[0, 0]
        for g in (coarse, grid)
    ]
    shared = images[1][fine[1] // 2 :: fine[1], fine[2] // 2 :: fine[2]]
    contrast = float((images[0] - math.sin(0.5) ** 2).abs().max())
    assert float((shared - images[0]).abs().max()) < tolerance * contrast


@pytest.mark.parametrize("shape", SIZES, ids=str)
@pytest.mark.parametrize(
    ("propagation", "interpolation"),
    [
        pytest.param(way, interpolation, marks=pytest.mark.slow if (way, interpolation) == ("rays", "linear") else ())
        for interpolation in ("linear", "cubic")
        for way in ("projection", "rays", "wave")
    ],
)
def test_any_size_gives_a_finite_image_and_gradient(shape, propagation, interpolation, smooth_field):
    grid = Grid(shape, (0.5, 0.2, 0.21))
    delta = smooth_field(grid, 0.02).requires_grad_()
    volume = Volume(grid, delta, N0)
    acquisition = Acquisition([Prism((0.1, -0.2), 1.1)], [0.7])
    images = image(volume, partially_coherent(), acquisition, Fidelity(propagation, interpolation=interpolation))
    assert images.shape == (1, 1, *shape[1:])
    assert bool(images.isfinite().all())
    images.square().sum().backward()
    assert bool(delta.grad.isfinite().all())


# --- numbers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_float32_is_within_its_own_rounding_of_float64(propagation, smooth_field, interpolation):
    """The phases of image formation reach k0·|z_f − z|·n0 ≈ 50 rad, each rounded to eps: 64 eps in all."""
    grid = Grid((8, 24, 26), (0.4, 0.2, 0.2))
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0), None], [2.0, 0.0, -3.0])
    delta, absorption = smooth_field(grid, 0.02), 0.002 * smooth_field(grid, seed=1).abs()
    double, single = (
        image(
            Volume(grid, delta.to(d), N0, absorption.to(d)),
            partially_coherent(),
            acquisition,
            Fidelity(propagation, interpolation=interpolation),
        )
        for d in (torch.float64, torch.float32)
    )
    assert single.dtype == torch.float32
    assert float((single - double).abs().max()) < 64 * eps(torch.float32)


def test_memory_changes_neither_the_image_nor_its_gradient(small, propagation, smooth_field):
    results = []
    for memory in (1, 40_000, 1 << 30):
        delta = smooth_field(small, 0.03).requires_grad_()
        volume = Volume(small, delta, N0, 0.003 * smooth_field(small, seed=1).abs())
        acquisition = Acquisition([Prism((0.1, 0.2), 1.0), None], [0.4, -0.3])
        images = image(volume, partially_coherent(), acquisition, Fidelity(propagation, memory=memory))
        (images * torch.arange(images.numel()).reshape(images.shape)).sum().backward()
        results.append((images.detach(), delta.grad))
    for images, gradient in results[:-1]:
        torch.testing.assert_close(images, results[-1][0], rtol=0, atol=1e-13)
        torch.testing.assert_close(gradient, results[-1][1], rtol=1e-10, atol=1e-10)


def test_padding_is_the_medium_around_the_specimen(small, propagation, smooth_field):
    """Fidelity.padding is what a volume padded with Δn = 0 by hand would give, cropped."""
    delta, absorption = smooth_field(small, 0.03), 0.003 * smooth_field(small, seed=1).abs()
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [0.4])
    padded = image(
        Volume(small, delta, N0, absorption), partially_coherent(), acquisition, Fidelity(propagation, padding=5)
    )
    assert padded.shape == (1, 1, 11, 14)
    wide = replace(small, shape=(4, 21, 24))
    fields = [torch.nn.functional.pad(f, (5, 5, 5, 5)) for f in (delta, absorption)]
    by_hand = image(Volume(wide, fields[0], N0, fields[1]), partially_coherent(), acquisition, Fidelity(propagation))
    assert torch.equal(padded, by_hand[..., 5:-5, 5:-5])
    plain = image(Volume(small, delta, N0, absorption), partially_coherent(), acquisition, Fidelity(propagation))
    assert float((plain - padded).abs().max()) > 0.01
