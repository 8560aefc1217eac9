import math
from dataclasses import replace

import pytest
import torch

from data_synthetic import GaussianBall
from recon.fit.bounds import Bounds
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium, on_voxels, pixels_of, shifted
from recon.fit.unknowns import IndexDifference
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), None, Prism((0.24, 0.0), -1.2)], [-0.7, 0.4])
FIDELITY = Fidelity(sources=4)
SIDES = [(16, 18), (15, 17), (16, 17), (13, 18)]


def ball(grid, centre=(0.2, -0.3, 0.4)):
    return GaussianBall(0.5, 0.02, BACKGROUND, centre).delta(grid, dtype=torch.float64)


def setup(sides=(16, 18), **known):
    grid = Grid((4, *sides), (0.5, 0.2, 0.21))
    return Setup(Volume(grid, ball(grid), BACKGROUND), MICROSCOPE, ACQUISITION, **known)


def pure(known):
    return image(known.volume, known.microscope, known.acquisition, FIDELITY)


def test_images_without_what_a_recording_does_are_those_of_the_microscope():
    assert torch.equal(setup().images(FIDELITY), pure(setup()))


def test_images_are_recorded_from_those_that_are_formed():
    known = setup(brightness=torch.rand(3, 2), drift=0.1 * torch.randn(3, 2, 2), margin=3)
    assert torch.equal(known.images(FIDELITY), known.recorded(known.formed(FIDELITY)))


def test_each_image_has_its_own_brightness():
    brightness = 1 + 0.1 * torch.randn(3, 2, dtype=torch.float64)
    images = setup(brightness=brightness).images(FIDELITY)
    torch.testing.assert_close(images, pure(setup()) * brightness[:, :, None, None], rtol=0, atol=1e-15)


@pytest.mark.parametrize("sides", SIDES)
def test_a_drift_of_whole_pixels_is_a_roll(sides):
    """A positive one moves the picture towards +y and +x."""
    rows, columns = torch.tensor([[0, 3], [-2, 1], [1, 0]]), torch.tensor([[2, -1], [0, 4], [-3, 5]])
    drift = torch.stack((0.2 * rows.double(), 0.21 * columns.double()), -1)
    found, expected = setup(sides, drift=drift).images(FIDELITY), pure(setup(sides))
    for p in range(3):
        for f in range(2):
            rolled = expected[p, f].roll((int(rows[p, f]), int(columns[p, f])), (0, 1))
            torch.testing.assert_close(found[p, f], rolled, rtol=0, atol=1e-12)


@pytest.mark.parametrize("sides", SIDES)
def test_a_drift_is_that_of_the_specimen(sides):
    """Exactly for waves, which are periodic, when the specimen's samples are moved in the same way."""
    known, by = setup(sides), torch.tensor([0.13, -0.29], dtype=torch.float64)
    grid = known.volume.grid
    moved = shifted(known.volume.delta[None], by.expand(1, grid.shape[0], 2), grid.spacing[1:])[0]
    expected = pure(replace(known, volume=Volume(grid, moved, BACKGROUND)))
    found = replace(known, drift=by.expand(3, 2, 2)).images(FIDELITY)
    # what the voxels' spacing leaves of the specimen's spectrum near its end
    assert float((found - expected).abs().max()) < 0.01 * float((expected - pure(known)).abs().max())


@pytest.mark.parametrize("sides", SIDES)
def test_shifts_add_up_and_undo_each_other(sides):
    # without the Nyquist frequency, of which a shift keeps its own part alone
    images = pure(setup(sides))
    a, b = 0.3 * torch.randn(2, 3, 2, 2, dtype=torch.float64)
    spacing = (0.2, 0.21)
    smooth = shifted(shifted(images, a, spacing), -a, spacing)
    torch.testing.assert_close(smooth, images, rtol=0, atol=1e-3 * float(images.std()))
    twice = shifted(shifted(images, a, spacing), b, spacing)
    torch.testing.assert_close(twice, shifted(images, a + b, spacing), rtol=0, atol=1e-3 * float(images.std()))


def test_a_shift_keeps_the_dtype():
    images = torch.rand(1, 1, 6, 5)
    assert shifted(images, torch.zeros(1, 1, 2, dtype=torch.float64), (0.2, 0.2)).dtype == torch.float32


@pytest.mark.parametrize("sides", SIDES)
def test_a_margin_leaves_the_wide_volumes_field(sides):
    known = setup(sides, margin=4)
    expected = pure(known)[..., 4:-4, 4:-4]
    assert torch.equal(known.images(FIDELITY), expected)
    assert known.shape == expected.shape
    assert known.field.shape == (4, sides[0] - 8, sides[1] - 8)


def test_what_drifts_in_from_the_margin_is_seen():
    """The shift comes before the cut: the specimen itself comes in, not what left on the other side."""
    known = setup(margin=4)
    drift = torch.tensor([0.2 * 3, -0.21 * 2], dtype=torch.float64).expand(3, 2, 2)
    expected = pure(known).roll((3, -2), (2, 3))[..., 4:-4, 4:-4]
    torch.testing.assert_close(replace(known, drift=drift).images(FIDELITY), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pixel", [0.2, 0.4, 0.33])
def test_a_cameras_pixels_look_at_the_field_within_the_margin(pixel):
    grid = Grid((4, 20, 24), (0.5, 0.2, 0.2))
    camera = replace(MICROSCOPE, camera=Camera(pixel_size=pixel))
    wide = Setup(Volume(grid, ball(grid), BACKGROUND), camera, ACQUISITION, margin=4)
    found, whole = wide.images(FIDELITY), replace(wide, margin=0).images(FIDELITY)
    assert found.shape == wide.shape
    assert whole.shape == replace(wide, margin=0).shape
    cut = [(n - m) // 2 for n, m in zip(whole.shape[2:], found.shape[2:], strict=True)]
    if all((n - m) % 2 == 0 for n, m in zip(whole.shape[2:], found.shape[2:], strict=True)):
        within = [slice(c, c + m) for c, m in zip(cut, found.shape[2:], strict=True)]
        torch.testing.assert_close(found, whole[..., within[0], within[1]], rtol=0, atol=1e-12)
    if pixel == 0.2:  # a voxel's own area
        assert found.shape[2:] == (12, 16)


def test_a_cameras_image_drifts_by_whole_pixels():
    grid = Grid((4, 20, 24), (0.5, 0.2, 0.2))
    camera = replace(MICROSCOPE, camera=Camera(pixel_size=0.4))
    known = Setup(Volume(grid, ball(grid), BACKGROUND), camera, ACQUISITION)
    drift = torch.tensor([0.8, -0.4], dtype=torch.float64).expand(3, 2, 2)
    moved = replace(known, drift=drift).images(FIDELITY)
    torch.testing.assert_close(moved, known.images(FIDELITY).roll((2, -1), (2, 3)), rtol=0, atol=1e-12)


def test_images_at_rest_are_without_drift_and_brightness():
    known = setup((15, 17), brightness=0.8 + 0.4 * torch.rand(3, 2), drift=0.1 * torch.randn(3, 2, 2))
    torch.testing.assert_close(known.at_rest(known.images(FIDELITY)), pure(setup((15, 17))), rtol=0, atol=1e-12)
    assert torch.equal(setup().at_rest(pure(setup())), pure(setup()))


def test_images_differentiate_in_what_a_recording_does():
    """Autograd against central differences, through the crop; float64."""
    known = setup(margin=2)
    formed = known.formed(FIDELITY)

    def recorded(brightness, drift):
        return replace(known, brightness=brightness, drift=drift).recorded(formed)

    brightness = (1 + 0.1 * torch.randn(3, 2, dtype=torch.float64)).requires_grad_()
    drift = (0.1 * torch.randn(3, 2, 2, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(recorded, (brightness, drift), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("known", "law"),
    [
        ({"brightness": torch.ones(2, 3)}, r"brightness has shape \(2, 3\), the acquisition asks for \(3, 2\)"),
        ({"drift": torch.zeros(2, 3, 2)}, r"drift has shape \(2, 3, 2\), the acquisition asks for \(3, 2, 2\)"),
        ({"margin": 8}, "margin 8 must be at least 0 and leave some of 16 × 18 voxels"),
        ({"margin": -1}, "margin -1 must be at least 0"),
    ],
)
def test_what_does_not_fit_is_refused(known, law):
    with pytest.raises(ValueError, match=law):
        setup(**known)


# what a descent asks of a setup


def test_a_problem_counts_the_margin():
    known = setup(margin=3)
    data = known.images(FIDELITY)
    recipe = Recipe(steps=1, draft_sources=None)
    assert Problem.from_recipe(data, known, FIDELITY, recipe).misfit.data.shape == (3, 2, 10, 12)
    with pytest.raises(ValueError, match=r"data have shape \(3, 2, 10, 12\), the acquisition and grid ask for"):
        Problem.from_recipe(data, replace(known, margin=0), FIDELITY, recipe)


def test_a_linear_start_fills_the_margin_from_the_fields_edge():
    known = setup(margin=3)
    data = known.images(FIDELITY)
    unknown = IndexDifference(5e-3, Bounds(None, None), "linear")
    delta = unknown.start(known, GaussianMisfit(data))
    narrow = Setup(empty_medium(known.field, BACKGROUND, data), MICROSCOPE, ACQUISITION)
    assert torch.equal(delta[:, 3:-3, 3:-3], unknown.start(narrow, GaussianMisfit(data)))
    assert torch.equal(delta[:, :, 0], delta[:, :, 3])
    assert torch.equal(delta[:, -1], delta[:, -4])


def test_a_linear_start_knows_the_drift_and_the_brightness():
    rest = setup((15, 17))
    known = replace(rest, brightness=0.8 + 0.4 * torch.rand(3, 2), drift=0.1 * torch.randn(3, 2, 2))
    unknown = IndexDifference(5e-3, Bounds(None, None), "linear")
    expected = unknown.start(rest, GaussianMisfit(rest.images(FIDELITY)))
    found = unknown.start(known, GaussianMisfit(known.images(FIDELITY)))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("pixel", [0.2, 0.3, 0.1])
def test_a_linear_start_from_a_cameras_pixels_is_near_that_from_voxels(pixel):
    grid = Grid((4, 24, 30), (0.5, 0.2, 0.2))
    plain = Setup(Volume(grid, ball(grid), BACKGROUND), MICROSCOPE, ACQUISITION)
    camera = replace(plain, microscope=replace(MICROSCOPE, camera=Camera(pixel_size=pixel)))
    index = IndexDifference(5e-3, Bounds(), "linear")
    starts = [index.value(index.start(each, GaussianMisfit(each.images(FIDELITY)))) for each in (plain, camera)]
    assert float((starts[1] - starts[0]).norm() / starts[0].norm()) < 0.12


@pytest.mark.parametrize("pixel", [0.1, 0.2, 0.3, 0.4])
def test_a_linear_ramp_on_a_cameras_pixels_is_the_same_ramp_on_voxels(pixel):
    """Cubic interpolation keeps straight lines; beyond the outermost pixels' centres they are held."""
    field = Grid((2, 20, 24), (0.5, 0.2, 0.2))
    pixels = pixels_of(field, replace(MICROSCOPE, camera=Camera(pixel_size=pixel)))

    def ramp(grid):
        y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
        return (0.3 * y[:, None] - 0.7 * x).expand(3, 2, -1, -1)

    found = on_voxels(ramp(pixels), pixels, field)
    within = (..., slice(4, -4), slice(4, -4))
    torch.testing.assert_close(found[within], ramp(field)[within], rtol=0, atol=1e-12)


@pytest.mark.parametrize("pixel", [0.4, 0.3, 0.13])
def test_a_misfit_on_a_cameras_pixels_differentiates_in_the_index(pixel):
    """Autograd against a central difference along a direction, through slabs and pixels; float64."""
    grid = Grid((3, 12, 14), (0.5, 0.2, 0.2))
    camera = replace(MICROSCOPE, camera=Camera(pixel_size=pixel))
    misfit = GaussianMisfit(Setup(Volume(grid, ball(grid), BACKGROUND), camera, ACQUISITION).images(FIDELITY))

    def value(delta):
        return misfit(Setup(Volume(grid, delta, BACKGROUND), camera, ACQUISITION).images(FIDELITY))

    delta = (0.5 * ball(grid)).requires_grad_()
    direction, step = 0.01 * torch.randn(grid.shape, dtype=torch.float64), 1e-3
    (gradient,) = torch.autograd.grad(value(delta), delta)
    with torch.no_grad():
        expected = (value(delta + step * direction) - value(delta - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(float(expected), rel=1e-6)


def test_a_specimen_that_goes_on_beyond_the_field_is_explained_with_a_margin_alone():
    """The true volume's misfit: exact with the margin, and far above what a hundredth of noise leaves without it."""
    grid = Grid((4, 20, 22), (0.5, 0.2, 0.21))
    wide = Setup(Volume(grid, ball(grid, (0.2, -1.2, 0.4)), BACKGROUND), MICROSCOPE, ACQUISITION, margin=4)
    misfit = GaussianMisfit(wide.images(FIDELITY))
    cut = Volume(wide.field, wide.volume.delta[:, 4:-4, 4:-4], BACKGROUND)
    assert float(misfit(wide.images(FIDELITY))) == 0
    assert float(misfit(Setup(cut, MICROSCOPE, ACQUISITION).images(FIDELITY))) > 0.01
    assert math.prod(wide.shape[2:]) == 12 * 14
