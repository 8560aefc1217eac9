"""Caustics inside the specimen: counted as known foci say, a quarter of a wave each, sought only where one can be."""

import cmath
import math

import pytest
import torch
from through import deviation, ray_field, tubes_that_may_fold

from data_synthetic import GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.plane_waves import to_field
from torchdic.propagation.split_step import split_step
from torchdic.rays import landing
from torchdic.rays.caustics import Tubes
from torchdic.rays.mesh import SURROUND
from torchdic.rays.trace import launch

N0 = 1.5
AXIAL = torch.zeros(1, 2, dtype=torch.float64)
CUBIC = Fidelity("rays", interpolation="cubic")


def graded(alpha_y, alpha_x, length, shape, spacing):
    """N² = n0²(1 − α_y² y² − α_x² x²): near the axis a ray tube's edges go as cos αz."""
    grid = Grid(shape, (length / shape[0], *spacing))
    y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    n2 = N0**2 * (1 - (alpha_y * y[:, None]) ** 2 - (alpha_x * x) ** 2)
    return Volume(grid, (n2.sqrt() - N0).expand(grid.shape).contiguous(), N0)


def apodised(volume, waist, wavelength):
    """With a first slice that absorbs all but a Gaussian beam exp(−r²/waist²): the edges of the array do not show."""
    y, x = (volume.grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    absorption = torch.zeros_like(volume.delta)
    absorption[0] = (y[:, None].square() + x.square()) / waist**2 * wavelength / (2 * math.pi * volume.grid.spacing[0])
    return Volume(volume.grid, volume.delta, volume.background, absorption)


def passed(volume, momentum=AXIAL, fidelity=CUBIC):
    tubes = tubes_that_may_fold(volume, momentum, fidelity)
    assert tubes is not None
    deviation(volume, launch(volume.grid, momentum, volume.background, 0.0, SURROUND), fidelity, watch=tubes)
    return tubes.passed()


# foci on the axis at αz = π/2, 3π/2, …; lengths in units of 1/α_x
RODS = {
    "before-the-line-focus": (0.0, 0.3, 0),
    "line-focus": (0.0, 0.8, 1),
    "half-a-pitch": (0.0, 1.2, 1),
    "two-line-foci": (0.0, 1.8, 2),
    "round-focus": (1.0, 0.8, 2),
    "two-round-foci": (1.0, 1.75, 4),
    "elliptic": (0.5, 1.8, 3),
}


WAYS = {
    "few-steps": Fidelity("rays", steps=11),
    "cubic": CUBIC,
    "linear": Fidelity("rays"),
    "adaptive": Fidelity("rays", solver="dopri5", tolerance=1e-4),
}


@pytest.mark.parametrize(
    ("ratio", "length", "caustics", "fidelity"),
    [
        pytest.param(
            *rod,
            fidelity,
            id=f"{way}-{name}",
            marks=() if way == "few-steps" or name == "two-round-foci" else pytest.mark.slow,
        )
        for way, fidelity in WAYS.items()
        for name, rod in RODS.items()
    ],
)
def test_each_focus_of_a_graded_index_rod_is_counted(ratio, length, caustics, fidelity):
    """On the axis by the Gouy phase: −π/2 for each, in the field behind it, with the amplitude of the tube's area."""
    alpha, rows = 0.2, 2 if ratio == 0 else 17
    volume = graded(ratio * alpha, alpha, length * math.pi / alpha, (36, rows, 17), (0.12, 0.12))
    count = passed(volume, fidelity=fidelity)
    middle = count[0, count.shape[1] // 2 - 1 : count.shape[1] // 2 + 1, count.shape[2] // 2 - 1 : count.shape[2] // 2]
    assert torch.equal(middle, torch.full_like(middle, caustics))

    # what an edge of the array sends to the axis is dark
    bright = apodised(volume, 0.3, 0.3)
    field = ray_field(bright, 0.3, AXIAL, volume.grid.extent[0] / 2, fidelity)[0, rows // 2, 8]
    # linear voxels: the slope of a parabola is exact between centres, and W on the axis is 0 but for δp of the corners
    turned = cmath.phase(complex(field) * 1j**caustics)
    assert turned == pytest.approx(0, abs=0.05)
    area = math.cos(length * math.pi) * math.cos(ratio * length * math.pi)
    assert abs(complex(field)) == pytest.approx(abs(area) ** -0.5, rel=0.05)


@pytest.mark.parametrize("length", [0.25, 2.25, *(pytest.param(n, marks=pytest.mark.slow) for n in (0.75, 1.25, 1.75))])
def test_beam_in_a_graded_index_slab_has_the_waves_phase(length):
    """A Gaussian beam, cut out by an absorbing first slice: on the axis (cos αz + iβ sin αz)^(−½), β = (mode/waist)².

    That is the ABCD law's answer for waves. Rays have it but for β, between foci.
    """
    alpha, waist, wavelength = 0.1, 1.8, 0.2
    extent = length * math.pi / alpha
    volume = apodised(graded(0.0, alpha, extent, (400, 1, 91), (0.1, 0.1)), waist, wavelength)
    rays = ray_field(volume, wavelength, AXIAL, extent / 2, Fidelity("rays", steps=50))[0, 0, 45]
    waves = to_field(split_step(volume, wavelength, AXIAL, Fidelity("wave")))[0, 0, 45]
    beta = wavelength / (math.pi * N0 * alpha) / waist**2
    assert beta < 0.15
    angle = length * math.pi
    # continuous: arg(cos + iβ sin) makes a turn as the angle does
    gouy = angle + cmath.phase(complex(math.cos(angle), beta * math.sin(angle)) * cmath.exp(-1j * angle))
    # what is not paraxial in the beam, (α·waist)⁴/8 of its path's phase
    assert cmath.phase(complex(waves) * cmath.exp(0.5j * gouy)) == pytest.approx(0, abs=0.02)
    # at a quarter of π from a focus β/2 of the quarter wave is still to come, or too much
    assert cmath.phase(complex(rays) / complex(waves)) == pytest.approx(0, abs=0.6 * beta)


def lens(slices, behind=0, contrast=0.11, n=28):
    """A strong ball in the middle of the first slices, which focuses some 4 µm behind it, and empty ones; its depth."""
    grid = Grid((slices + behind, n, n - 3), (0.25, 0.18, 0.19))
    centre = -behind * 0.25 / 2
    ball = GaussianBall(0.8, contrast, 1.36, (centre, 0.12, -0.2)).delta(grid)
    # splines and linear interpolation end within two slices
    ball[slices - 2 :] = 0
    return Volume(grid, ball, 1.36), centre


@pytest.mark.parametrize(
    "momentum",
    [pytest.param((0.0, 0.0), id="axial", marks=pytest.mark.slow), pytest.param((0.35, -0.2), id="oblique")],
)
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="linear", marks=pytest.mark.slow),
        pytest.param({"interpolation": "cubic"}, id="cubic"),
        pytest.param({"memory": 1}, id="recomputed"),
        pytest.param({"solver": "dopri5", "tolerance": 1e-7}, id="adaptive", marks=pytest.mark.slow),
    ],
)
def test_empty_slices_behind_do_not_show(momentum, options):
    """Whether a focus lies before or behind the last face, the field at a plane in the ball is the same."""
    fidelity = Fidelity("rays", **options)
    source = torch.tensor([momentum], dtype=torch.float64)
    (short, plane), (long, other) = lens(26), lens(26, behind=40)
    count = passed(long, source, fidelity)
    # where the ball's rim is weaker, the focus lies farther, and one caustic before the other
    assert {0.0, 1.0, 2.0} <= set(count.flatten().tolist())
    near, far = (ray_field(v, 0.3, source, z + 0.25, fidelity) for v, z in ((short, plane), (long, other)))
    # a spline's ringing falls by 2 − √3 a voxel, and the two volumes end at different ones
    torch.testing.assert_close(far, near, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_image_of_a_ball_that_focuses_inside_the_volume_is_the_waves(monkeypatch):
    """The fields of axial and oblique sources through a strong ball whose focus lies inside the volume.

    Rms of the image over its standard deviation: below 1 %, as for weak balls, and a picture of something else without.
    """
    volume, centre = lens(26, behind=24, n=48)
    points = torch.tensor([[0.0, 0.0], [0.35, -0.2], [-0.3, 0.4]], dtype=torch.float64)
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.5, points))
    acquisition = Acquisition([Prism((0.0, 0.24), math.pi / 2)], [centre, centre + 1.0, centre + 2.0])

    def of(fidelity):
        return image(volume, microscope, acquisition, fidelity)

    waves = of(Fidelity("wave"))
    error = ((of(CUBIC) - waves).square().mean((2, 3)).sqrt() / waves.std((2, 3)))[0]
    monkeypatch.setattr(landing, "tubes_that_may_fold", lambda *_: None)
    without = ((of(CUBIC) - waves).square().mean((2, 3)).sqrt() / waves.std((2, 3)))[0]
    assert float(error.max()) < 0.01
    assert float(without.min()) > 0.5


# --- sought only where one can be ------------------------------------------------------------------------------------


@pytest.fixture
def looks(monkeypatch):
    """How often tubes were looked at."""
    calls = []
    plain = Tubes.__call__
    monkeypatch.setattr(Tubes, "__call__", lambda self, state: calls.append(1) or plain(self, state))
    return calls


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_smooth_ball_is_not_searched_and_a_strong_lens_is(looks, interpolation):
    grid = Grid((28, 40, 40), (0.5, 0.3, 0.3))
    momentum = torch.tensor([[0.0, 0.0], [0.5, -0.5]], dtype=torch.float64)
    fidelity = Fidelity("rays", interpolation=interpolation)
    ray_field(Volume(grid, GaussianBall(2.0, 0.03, 1.36).delta(grid), 1.36), 0.546, momentum, 0.0, fidelity)
    assert len(looks) == 0
    volume, _ = lens(26)
    ray_field(volume, 0.546, momentum, 0.0, fidelity)
    assert len(looks) == 26


@pytest.mark.parametrize(
    ("momentum", "interpolation"),
    [
        pytest.param((0.0, 0.0), "linear", id="axial-linear"),
        pytest.param((0.35, -0.2), "cubic", id="oblique-cubic", marks=pytest.mark.slow),
        pytest.param((0.0, 0.0), "cubic", id="axial-cubic", marks=pytest.mark.slow),
        pytest.param((0.35, -0.2), "linear", id="oblique-linear", marks=pytest.mark.slow),
    ],
)
def test_no_fold_escapes_the_bound_and_it_is_not_much_too_wary(interpolation, momentum):
    """As a ball becomes stronger, its tubes are followed from some contrast on, and some fold from a higher one on."""
    source, fidelity = torch.tensor([momentum], dtype=torch.float64), Fidelity("rays", interpolation=interpolation)

    def followed(contrast):
        return tubes_that_may_fold(lens(26, 16, contrast)[0], source, fidelity) is not None

    def folded(contrast):
        volume, _ = lens(26, 16, contrast)
        tubes = Tubes(volume.grid, 1.0)
        least = [1.0]

        def watch(state):
            tubes(state)
            least.append(float(tubes._area.min()))

        deviation(volume, launch(volume.grid, source, volume.background, 0.0, SURROUND), fidelity, watch=watch)
        return min(least) <= 0

    def onset(happens):
        low, high = 0.0, 0.3
        assert happens(high)
        for _ in range(6):
            middle = (low + high) / 2
            low, high = (low, middle) if happens(middle) else (middle, high)
        return high

    wary, real = onset(followed), onset(folded)
    assert real / 4 < wary < real


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_bound_holds_where_index_meets_the_sides(smooth_field, interpolation):
    """A field that is nowhere flat, in grids down to one voxel, with steep light: tubes not followed do not fold."""
    free = 0
    for shape in ((5, 9, 8), (3, 1, 9), (4, 8, 1), (1, 6, 7)):
        grid = Grid(shape, (0.5, 0.3, 0.35))
        for size in (0.003, 0.01, 0.03, 0.1, 0.3):
            for p0 in (0.0, 0.6, 0.9, 1.2):
                volume = Volume(grid, smooth_field(grid, size), 1.36)
                source = torch.tensor([[0.0, p0]], dtype=torch.float64)
                fidelity = Fidelity("rays", interpolation=interpolation)
                if tubes_that_may_fold(volume, source, fidelity) is not None:
                    continue
                free += 1
                tubes, areas = Tubes(grid, 1.0), []
                start = launch(grid, source, volume.background, 0.0, SURROUND)
                deviation(volume, start, fidelity, watch=lambda s, t=tubes, a=areas: (t(s), a.append(t._area.min())))
                assert float(torch.stack(areas).min()) > 0
    assert free > 10


def test_empty_or_layered_volume_cannot_fold():
    grid = Grid((4, 6, 7), (0.5, 0.2, 0.2))
    layers = torch.tensor([0.0, 0.3, -0.2, 0.1], dtype=torch.float64)[:, None, None].expand(grid.shape).contiguous()
    for delta in (torch.zeros_like(layers), layers):
        for p0 in (0.0, 1.1):
            source = torch.tensor([[p0, 0.0]], dtype=torch.float64)
            assert tubes_that_may_fold(Volume(grid, delta, 1.36), source, Fidelity("rays")) is None


@pytest.mark.parametrize("options", [{}, {"interpolation": "cubic"}, {"steps": 7}, {"memory": 1}], ids=str)
def test_looking_changes_no_bit_where_nothing_folds(monkeypatch, smooth_field, dtype, options):
    grid = Grid((6, 20, 22), (0.6, 0.22, 0.2))
    delta = smooth_field(grid, 0.01, dtype).requires_grad_()
    momentum = torch.tensor([[0.3, -0.2], [-0.5, 0.4]], dtype=dtype)

    def of():
        field = ray_field(Volume(grid, delta, 1.36), 0.546, momentum, 0.3, Fidelity("rays", **options))
        (gradient,) = torch.autograd.grad(field.real.sum(), delta)
        return field, gradient

    plain = of()
    monkeypatch.setattr(landing, "tubes_that_may_fold", lambda volume, *_: Tubes(volume.grid, 1.0))
    found = of()
    assert torch.equal(found[0], plain[0])
    # slabs' gradients are added up in another order
    torch.testing.assert_close(
        found[1], plain[1], rtol=0, atol=100 * torch.finfo(dtype).eps * float(plain[1].abs().max())
    )


@pytest.mark.parametrize("options", [{}, {"memory": 1}], ids=["kept", "recomputed"])
def test_gradient_behind_a_fold_is_the_central_difference(options):
    volume, centre = lens(26, behind=16, n=13)
    fidelity = Fidelity("rays", **options)
    assert tubes_that_may_fold(volume, AXIAL, fidelity) is not None
    weights = torch.randn(1, 13, 10, dtype=torch.complex128)

    def of(delta):
        return (weights * ray_field(Volume(volume.grid, delta, 1.36), 0.546, AXIAL, centre, fidelity)).real.sum()

    value = volume.delta.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(of(value), value)
    direction = torch.randn_like(gradient).abs() * torch.where(gradient < 0, -1.0, 1.0)
    # so small a step that hardly any ray goes from one piece of the field or the mesh to the next
    step = 1e-10
    at = [float(of(volume.delta + t * step * direction)) for t in (-2, -1, 1, 2)]
    expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5)
