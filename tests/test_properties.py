"""Random smooth volumes, microscopes and acquisitions: what every image and gradient obeys, found by hypothesis."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.errors import SidewaysError, TurnedRaysError, UnstableError
from torchdic.propagation.split_step import MOST_ENERGY

REFUSALS = (TurnedRaysError, SidewaysError, UnstableError)
everywhere = pytest.mark.parametrize("propagation", ["projection", "rays", "wave"])
coarse = pytest.mark.filterwarnings(
    "ignore::torchdic.SamplingWarning",
    "ignore::torchdic.errors.WrapAroundWarning",
    "ignore::torchdic.errors.SlabWarning",
)
# the same examples every time: a failure is the code's, not the day's
few = settings(
    max_examples=8, deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)


@dataclass(frozen=True, eq=False)
class Scene:
    """A volume, a microscope and an acquisition, float64."""

    grid: Grid
    delta: Tensor
    absorption: Tensor | None
    background: float
    wavelength: float
    na: float
    points: Tensor
    shear: Tensor
    bias: float
    focus: float
    aberrations: dict[int, float]
    options: dict[str, object]

    def images(self, propagation: str) -> Tensor:
        """Of a prism and of the bright field, (2, 1, y, x)."""
        try:
            return image(
                Volume(self.grid, self.delta, self.background, self.absorption),
                Microscope(self.wavelength, Objective(self.na, self.aberrations), Condenser(0.3, self.points)),
                Acquisition([Prism(self.shear, self.bias), None], [self.focus]),
                Fidelity(propagation, **self.options),
            )
        except REFUSALS:
            reject()

    def turned(self, turn) -> "Scene":
        """With everything that is a field, and so the grid, changed by a function of a (z, y, x) tensor."""
        delta = turn(self.delta)
        return replace(self, delta=delta, absorption=None if self.absorption is None else turn(self.absorption))


def field(grid: Grid, seed: int) -> Tensor:
    """Within ±1, periodic across the sides, of one period or two along each axis."""
    random = torch.Generator().manual_seed(seed)
    total = torch.zeros(grid.shape, dtype=torch.float64)
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) / n for n in grid.shape), indexing="ij")
    for _ in range(4):
        kz, ky, kx = torch.randint(-2, 3, (3,), generator=random).tolist()
        phase = float(torch.rand((), generator=random))
        total += torch.cos(2 * math.pi * (kz * z / 2 + ky * y + kx * x + phase)) / 4
    return total


@st.composite
def scenes(draw, odd=False):
    def number(low, high):
        return draw(st.floats(low, high, allow_subnormal=False))

    across = st.integers(0, 6).map(lambda n: 2 * n + 1) if odd else st.integers(1, 13)
    grid = Grid(
        (draw(st.integers(1, 5)), draw(across), draw(across)), (number(0.1, 0.6), number(0.12, 0.3), number(0.12, 0.3))
    )
    background = number(1.3, 1.6)
    angles = draw(st.lists(st.tuples(st.floats(0, 0.9), st.floats(0, 6.28)), min_size=1, max_size=4))
    points = torch.tensor([[r * math.sin(a), r * math.cos(a)] for r, a in angles], dtype=torch.float64)
    aberrations = draw(st.dictionaries(st.integers(2, 11), st.floats(-1, 1, allow_subnormal=False), max_size=3))
    options = {
        "interpolation": draw(st.sampled_from(["linear", "cubic"])),
        "order": draw(st.sampled_from([1, 2])),
        "steps": draw(st.sampled_from([None, 1, 3, 8])),
    }
    absorption = 0.01 * (1 + field(grid, draw(st.integers(0, 99)))) if draw(st.booleans()) else None
    return Scene(
        grid,
        number(-0.05, 0.05) * field(grid, draw(st.integers(0, 999))),
        absorption,
        background,
        number(0.4, 0.8),
        number(0.2, 1.2),
        points,
        torch.tensor([number(-0.5, 0.5), number(-0.5, 0.5)], dtype=torch.float64),
        number(-7, 7),
        number(-8, 8),
        aberrations,
        options,
    )


def assert_close(found, expected, tolerance=1e-10):
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@everywhere
@coarse
@few
@given(scene=scenes())
def test_images_and_gradients_are_finite_and_no_light_is_made(propagation, scene):
    learned = [scene.delta.clone().requires_grad_(), scene.shear.clone().requires_grad_()]
    images = replace(scene, delta=learned[0], shear=learned[1]).images(propagation)
    assert bool(images.isfinite().all())
    assert float(images.detach().min()) >= 0
    # a wave's energy is p_z·|S|²: the obliquest light that the pupil takes has the least p_z for it
    bound = {"projection": 1 + 1e-12, "rays": MOST_ENERGY}.get(propagation)
    if bound is None:
        bound = MOST_ENERGY * scene.background / math.sqrt(scene.background**2 - scene.na**2)
    assert float(images[1].detach().mean()) <= bound
    for gradient in torch.autograd.grad(images.square().sum(), learned):
        assert bool(gradient.isfinite().all())


@everywhere
@coarse
@few
@given(scene=scenes())
def test_reversing_shear_and_bias_changes_no_bit(propagation, scene):
    other = replace(scene, shear=-scene.shear, bias=-scene.bias).images(propagation)
    assert torch.equal(other, scene.images(propagation))


@everywhere
@coarse
@few
@given(scene=scenes())
def test_swapping_y_and_x_of_everything_transposes_the_images(propagation, scene):
    # the terms that y and x enter alike
    scene = replace(scene, aberrations={n: a for n, a in scene.aberrations.items() if n in (4, 5, 11)})
    grid = Grid(*((v[0], v[2], v[1]) for v in (scene.grid.shape, scene.grid.spacing)))
    other = replace(scene.turned(lambda f: f.transpose(1, 2)), grid=grid, points=scene.points.flip(1))
    other = replace(other, shear=scene.shear.flip(0))
    assert_close(other.images(propagation).transpose(-1, -2), scene.images(propagation))


@everywhere
@coarse
@few
@given(scene=scenes(odd=True))
def test_mirroring_y_and_x_of_everything_mirrors_the_images(propagation, scene):
    # odd sizes: an even one holds the Nyquist frequency with one sign only
    scene = replace(scene, aberrations={n: a for n, a in scene.aberrations.items() if n in (4, 5, 6, 11)})
    other = replace(scene.turned(lambda f: f.flip(1, 2)), points=-scene.points, shear=-scene.shear)
    assert_close(other.images(propagation).flip(-1, -2), scene.images(propagation))


@coarse
@few
@given(scene=scenes(), rows=st.integers(-6, 6), columns=st.integers(-6, 6))
def test_wave_shifts_its_images_with_the_specimen_by_whole_pixels(scene, rows, columns):
    other = scene.turned(lambda f: f.roll((rows, columns), (1, 2))).images("wave")
    assert_close(other, scene.images("wave").roll((rows, columns), (2, 3)))


@everywhere
@coarse
@few
@given(scene=scenes(), seed=st.integers(0, 2**31))
def test_seeds_reproduce_bit_for_bit(propagation, scene, seed):
    recordings = []
    for _ in range(2):
        images = scene.images(propagation)
        generator = torch.Generator().manual_seed(seed)
        recordings.append((images, Camera(photons=1000, read_noise=2.0, bits=12).record(images, generator)))
    assert torch.equal(recordings[0][0], recordings[1][0])
    assert torch.equal(recordings[0][1], recordings[1][1])
