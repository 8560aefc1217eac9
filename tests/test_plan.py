import json
import math
import re
import tomllib
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise

import pytest
import tomli_w
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from data_synthetic import Bead, CellPhantom, GaussianBall
from recon.cli import main
from recon.config.conversion import dump
from recon.config.reading import load
from recon.fit.newton.descent import COARSE_STEPS
from recon.fit.planned import GROWTH, current, follow, strength
from recon.fit.setup import Setup
from recon.run import recorded
from torchdic import (
    REFERENCE,
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Plan,
    Polarisation,
    Prism,
    Spectrum,
    ToleranceWarning,
    Volume,
    image,
    plan,
)
from torchdic.errors import UnstableError, WrapAroundWarning
from torchdic.files.stack import read_volume
from torchdic.planning import pilots
from torchdic.planning.cost import work
from torchdic.planning.image_error import FLOOR, image_error
from torchdic.planning.ladders import PILOT_SHARE, way_ladder
from torchdic.planning.plan import describe

GRID = Grid((16, 48, 48), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
SHEARED = Prism((0.0, 0.2), math.pi / 2)
ACQUISITION = Acquisition([SHEARED, Prism((0.2, 0.0), -math.pi / 2)], [-1.0, 0.0, 1.0])
# What float32 leaves in an image, in units of the empty bright field: a sum of some hundred terms.
ROUNDING = 8 * torch.finfo(torch.float32).eps


@dataclass(frozen=True, eq=False)
class Scene:
    volume: Volume
    tolerance: float
    microscope: Microscope = MICROSCOPE
    acquisition: Acquisition = ACQUISITION
    # how far the truth's sides are moved away; 0 where the specimen reaches them, and the array is periodic
    padding: int = 24

    def plan(self) -> Plan:
        return plan(self.volume, self.microscope, self.acquisition, self.tolerance)

    @torch.no_grad()
    def image(self, fidelity):
        return image(self.volume, self.microscope, self.acquisition, fidelity)

    def truth(self, made):
        """A wave with twice the plan's slabs at least, twice its sources and wider sides: nothing the plan computed."""
        steps = max(3 * self.volume.grid.shape[0], 2 * (made.fidelity.steps or 0))
        sources = max(98, 2 * made.fidelity.sources)
        return self.image(Fidelity("wave", steps=steps, sources=sources, padding=self.padding))


def volume(delta, grid=GRID, background=1.36, absorption=None):
    return Volume(grid, delta.float(), background, absorption)


def gaussian(contrast, size, grid=GRID, background=1.36):
    return volume(GaussianBall(size, contrast, background).delta(grid), grid, background)


def empty():
    grid = Grid((8, 24, 32), (0.4, 0.2, 0.2))
    return Scene(volume(torch.zeros(grid.shape), grid), 0.01, padding=8)


def thin_weak():
    grid = Grid((8, 32, 32), (0.4, 0.2, 0.2))
    delta = torch.zeros(grid.shape)
    y, x = (grid.coordinates(axis) for axis in (1, 2))
    delta[4] = 0.01 * torch.exp(-(y[:, None] ** 2 + (x - 0.3) ** 2) / 2 / 0.6**2)
    return Scene(volume(delta, grid), 0.03, padding=16)


def weak_bead():
    return Scene(volume(Bead(1.5, 0.005, 1.56).delta(GRID), background=1.56), 0.05)


def cell():
    grid = Grid((20, 64, 64), (0.4, 0.2, 0.2))
    return Scene(volume(CellPhantom().delta(grid), grid, 1.335), 0.03)


def layered():
    grid = Grid((8, 24, 32), (0.4, 0.2, 0.2))
    z = grid.coordinates(0)[:, None, None]
    return Scene(volume((0.02 * torch.sin(z)).expand(grid.shape), grid), 0.01, padding=0)


def thick_rod():
    y, x = (GRID.coordinates(axis) for axis in (1, 2))
    delta = 0.03 * torch.exp(-(y[:, None] ** 2 + x**2) / 2 / 1.2**2)
    return Scene(volume(delta.expand(GRID.shape)), 0.02, padding=0)


def sharp_strong_bead():
    grid = Grid((20, 40, 40), (0.2, 0.2, 0.2))
    return Scene(volume(Bead(1.2, 0.08, 1.36).delta(grid), grid), 0.1)


def absorbing():
    scene = gaussian(0.01, 0.8)
    kappa = 0.2 * scene.delta.clamp_min(0)
    return Scene(Volume(GRID, scene.delta, scene.background, kappa), 0.02)


def coherent():
    grid = Grid((10, 36, 40), (0.4, 0.2, 0.2))
    return Scene(gaussian(0.02, 0.8, grid), 0.02, replace(MICROSCOPE, condenser=None))


def wide_condenser():
    grid = Grid((12, 44, 48), (0.4, 0.16, 0.16))
    return Scene(gaussian(0.02, 0.6, grid), 0.1, Microscope(0.546, Objective(0.9), Condenser(0.8)))


def far_out_of_focus():
    return Scene(gaussian(0.02, 0.8), 0.02, acquisition=Acquisition([SHEARED], [-8.0, 8.0]))


def ring_and_bright_field():
    ring = Microscope(0.546, Objective(0.75), Condenser(0.5, inner_na=0.4))
    return Scene(gaussian(0.02, 1.0), 0.1, ring, Acquisition([None, Prism((0.1, 0.1), 0.6)], [0.0, 1.5]))


def many_colours():
    spectrum = Spectrum([0.47, 0.49, 0.51, 0.53, 0.56, 0.6, 0.65], [1, 3, 4, 5, 4, 2, 1])
    return Scene(gaussian(0.02, 0.6), 0.02, replace(MICROSCOPE, spectrum=spectrum))


SIMPLE = [thin_weak, empty, layered]
REST = [
    coherent,
    weak_bead,
    cell,
    thick_rod,
    sharp_strong_bead,
    absorbing,
    wide_condenser,
    far_out_of_focus,
    ring_and_bright_field,
    many_colours,
]


@dataclass(frozen=True)
class Outcome:
    made: Plan
    error: float
    rounding: float

    def predicted_within(self, factor):
        return self.error < self.rounding or 1 / factor < self.made.error / self.error < factor


def outcome(scene):
    made = scene.plan()
    truth = scene.truth(made)
    contrast = float(truth.std((2, 3), correction=0).clamp_min(FLOOR).min())
    return Outcome(made, image_error(scene.image(made.fidelity), truth), ROUNDING / contrast)


# the error's definition


def test_error_is_the_worst_images_rms_over_its_contrast():
    truth = torch.zeros(2, 1, 4, 4)
    truth[0, 0, ::2] = 1  # standard deviation 0.5
    truth[1, 0, ::2] = 4  # 2
    images = truth + torch.tensor([0.1, 0.2])[:, None, None, None]
    assert image_error(images, truth) == pytest.approx(0.2)
    assert image_error(truth, truth) == 0


def test_an_empty_images_error_is_measured_by_the_floor():
    assert image_error(torch.full((1, 1, 3, 3), 0.5 + 1e-4), torch.full((1, 1, 3, 3), 0.5)) == pytest.approx(
        1e-4 / FLOOR, rel=1e-2
    )


# the plan keeps its word


@pytest.mark.parametrize("make", SIMPLE, ids=lambda make: make.__name__)
def test_a_simple_scenes_plan_keeps_its_word(make):
    scene = make()
    found = outcome(scene)
    assert found.made.met
    assert found.error <= scene.tolerance
    assert found.predicted_within(3), found
    assert work_ratio(scene, found.made) > 5


def work_ratio(scene, made):
    """REFERENCE's work over the plan's."""
    rest = scene.volume, scene.microscope, scene.acquisition
    return work(REFERENCE, *rest) / work(made.fidelity, *rest)


@pytest.mark.slow
def test_every_plan_meets_its_tolerance_and_nine_of_ten_predict_within_a_factor_3():
    scenes = [make() for make in SIMPLE + REST] + random_scenes(8)
    missed, astray = [], []
    for number, scene in enumerate(scenes):
        found = outcome(scene)
        fidelity, predicted = describe(found.made.fidelity), found.made.error
        row = f"{number}: {fidelity}, predicted {predicted:.2g}, realised {found.error:.2g} of {scene.tolerance:g}"
        print(row, flush=True)
        if not (found.made.met and found.error <= scene.tolerance):
            missed.append(row)
        if not found.predicted_within(3):
            astray.append(row)
    assert not missed
    assert len(astray) <= len(scenes) / 10, astray


DRAWN = {
    "size": st.floats(0.5, 0.8),
    "sign": st.sampled_from([-1, 1]),
    "magnitude": st.floats(-3.0, -1.4),
    "na": st.floats(0.4, 0.75),
    "filled": st.floats(0.1, 0.7),
    "bias": st.floats(0.5, 2.5),
    "shear": st.tuples(st.floats(-0.2, 0.2), st.floats(0.1, 0.2)),
    "focus": st.floats(-3.0, 3.0),
}


def random_scene(values):
    grid = Grid((12, 40, 44), (0.4, 0.2, 0.2))
    na = values["na"]
    microscope = Microscope(0.546, Objective(na), Condenser(values["filled"] * na))
    acquisition = Acquisition([Prism(values["shear"], values["bias"])], sorted({0.0, values["focus"]}))
    contrast = values["sign"] * 10 ** values["magnitude"]
    return Scene(gaussian(contrast, values["size"], grid), 0.05, microscope, acquisition)


def random_scenes(count):
    """The same scenes each time, drawn by hypothesis."""
    drawn = []

    @settings(max_examples=count, derandomize=True, database=None, deadline=None)
    @given(st.fixed_dictionaries(DRAWN))
    def collect(values):
        drawn.append(values)

    collect()
    return [random_scene(values) for values in drawn]


# what it says of the effects


def by_name(made):
    return {effect.name: effect for effect in made.effects}


def test_effects_not_declared_are_absent_at_no_cost():
    effects = by_name(coherent().plan())
    for name in ("partial coherence", "polarisation", "absorption", "camera"):
        effect = effects[name]
        assert (effect.needed, effect.error, effect.cost, effect.basis) == (False, 0.0, 0.0, "absent")


def test_the_table_names_every_effect():
    made = coherent().plan()
    for name in (
        "bending",
        "amplitude",
        "diffraction",
        "object aberration",
        "partial coherence",
        "steps",
        "defocus",
        "sides",
        "polarisation",
        "absorption",
        "camera",
    ):
        assert name in made.table()
    assert json.loads(json.dumps(made.as_dict()))["fidelity"]["steps"] == made.fidelity.steps


def test_declared_effects_are_worth_what_leaving_them_out_changes():
    scene = coherent()
    grid, delta = scene.volume.grid, scene.volume.delta
    dark = Volume(grid, delta, 1.36, 0.3 * delta)
    camera = Camera(pixel_size=0.4)
    microscope = replace(scene.microscope, polarisation=Polarisation(analyser_error=0.2), camera=camera)
    made = plan(dark, microscope, scene.acquisition, 0.05)
    effects = by_name(made)
    truth = image(dark, microscope, scene.acquisition)
    clear = image(Volume(grid, delta, 1.36), microscope, scene.acquisition)
    ideal = image(dark, replace(microscope, polarisation=None), scene.acquisition)
    assert effects["absorption"].needed
    assert effects["absorption"].cost > 0
    assert effects["polarisation"].needed
    # the pilots' slabs are coarser, and its window is the whole array here
    assert effects["absorption"].error == pytest.approx(image_error(clear, truth), rel=0.2)
    assert effects["polarisation"].error == pytest.approx(image_error(ideal, truth), rel=0.2)
    assert effects["camera"].error > 0


def test_no_source_but_the_axis_is_needed_without_a_condenser():
    made = coherent().plan()
    assert made.fidelity.sources == 1


def test_a_condensers_own_directions_are_all_used():
    points = torch.tensor([[0.0, 0.0], [0.2, 0.1], [-0.2, -0.1]])
    microscope = replace(MICROSCOPE, condenser=Condenser(0.3, points))
    made = plan(gaussian(0.005, 0.6, Grid((6, 28, 28), (0.4, 0.2, 0.2))), microscope, ACQUISITION, 0.2)
    assert made.fidelity.sources == 3
    assert by_name(made)["partial coherence"].basis == "absent"


def test_layers_that_average_to_nothing_are_not_overlooked():
    """Slices of alternating sign vanish in every thicker slab."""
    grid = Grid((8, 40, 40), (0.5, 0.2, 0.2))
    y, x = (grid.coordinates(axis) for axis in (1, 2))
    bump = torch.exp(-(y[:, None] ** 2 + x**2) / 2)
    signs = torch.tensor([1.0, -1.0]).repeat(4)[:, None, None]
    scene = Scene(volume(0.02 * signs * bump, grid), 0.05, replace(MICROSCOPE, condenser=None))
    found = outcome(scene)
    assert found.made.met
    assert found.error <= scene.tolerance
    assert by_name(found.made)["steps"].needed


def test_a_tighter_tolerance_never_predicts_more_error_nor_less_work():
    scene = coherent()
    rest = scene.volume, scene.microscope, scene.acquisition
    plans = [plan(*rest, tolerance) for tolerance in (0.1, 0.01, 0.001)]
    errors = [made.error for made in plans]
    costs = [work(made.fidelity, *rest) for made in plans]
    assert errors == sorted(errors, reverse=True)
    assert costs == sorted(costs)
    assert costs[-1] > costs[0]


def test_specimens_that_stay_clear_of_the_sides_are_padded_where_light_comes_round():
    grid = Grid((8, 32, 32), (0.4, 0.2, 0.2))
    microscope = Microscope(0.546, Objective(0.75))
    far = Acquisition([SHEARED], [10.0])
    assert plan(gaussian(0.02, 0.6, grid), microscope, far, 0.02).fidelity.padding > 0


# strong specimens


def strong(contrast, microscope=MICROSCOPE):
    """A bead whose index jumps by so much that slabs which take part of it in make energy."""
    grid = Grid((12, 32, 32), (0.4, 0.2, 0.2))
    return Scene(volume(Bead(1.2, contrast, 1.36).delta(grid), grid), 0.2, microscope, padding=16)


@pytest.mark.slow
def test_a_specimen_too_strong_for_thick_slabs_is_planned_with_finer_ones():
    scene = strong(0.3)
    for coarse in (Fidelity(steps=8, order=1), Fidelity(order=1), Fidelity(steps=24, order=1)):
        with pytest.raises(UnstableError):
            scene.image(coarse)
    found = outcome(scene)
    assert found.made.met
    assert found.error <= scene.tolerance
    assert found.predicted_within(3), found
    assert by_name(found.made)["steps"].needed


def test_the_converged_wave_is_finite_where_only_thin_slabs_carry_the_light():
    """One slab a slice makes energy, and so do eight; the ladder goes on to the first two that don't."""
    scene = strong(0.5, replace(MICROSCOPE, condenser=None))
    for steps in (12, 96):
        with pytest.raises(UnstableError):
            scene.image(Fidelity(steps=steps))
    ways, truth = way_ladder(pilots.Scene(scene.volume, scene.microscope, scene.acquisition), scene.tolerance)
    assert bool(torch.isfinite(truth).all())
    assert all(bool(torch.isfinite(way.lacks).all()) for way in ways)
    assert {way.fidelity.steps for way in ways if way.fidelity.order == 2} >= {192, 384}


@pytest.mark.slow
def test_slabs_that_carry_a_few_sources_but_not_all_are_not_chosen():
    """Of the pilot's sources none makes energy in 24 slabs, of 50 two do."""
    scene = strong(0.3)
    few = pilots.Scene(scene.volume, scene.microscope, scene.acquisition).lit(18)
    few(Fidelity(steps=24))
    with pytest.raises(UnstableError):
        scene.image(Fidelity(steps=24, sources=50))
    scene.image(scene.plan().fidelity)


def test_a_specimen_that_no_slabs_carry_is_said_to_be_one():
    grid = Grid((6, 24, 24), (0.4, 0.2, 0.2))
    with pytest.raises(ValueError, match=r"can't go on toward \+z"):
        plan(volume(-62 * GaussianBall(0.6, 0.018, 1.36).delta(grid), grid), MICROSCOPE, ACQUISITION, 0.2)


def test_pilots_keep_their_warnings_to_themselves():
    """A window may be too narrow for a focus that the whole array has room for."""
    grid = Grid((4, 128, 128), (0.4, 0.2, 0.2))
    scene = Scene(gaussian(0.3, 0.3, grid), 0.1, Microscope(0.546, Objective(0.75)), Acquisition([SHEARED], [16.0]))
    pilot = pilots.Scene(scene.volume, scene.microscope, scene.acquisition).window()
    with pytest.warns(WrapAroundWarning):
        pilot(Fidelity())
    scene.image(scene.plan().fidelity)


# what an image costs


@pytest.mark.slow
def test_a_camera_does_not_keep_a_strong_specimen_from_being_planned():
    grid = Grid((4, 32, 32), (1.0, 0.2, 0.2))
    microscope = replace(MICROSCOPE, camera=Camera(pixel_size=0.4))
    bead = gaussian(0.25, 1.0, grid)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ToleranceWarning)
        made = plan(bead, microscope, ACQUISITION, 0.2)
    assert math.isfinite(made.error)
    assert all(math.isfinite(e.error) for e in made.effects)


@pytest.mark.slow
def test_a_pixel_wider_than_the_rays_window_leaves_their_estimates():
    microscope = replace(MICROSCOPE, camera=Camera(pixel_size=7.0))
    ball = gaussian(0.03, 1.2, Grid((10, 80, 80), (0.4, 0.2, 0.2)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ToleranceWarning)
        effects = by_name(plan(ball, microscope, ACQUISITION, 1e-4))
    assert effects["bending"].basis == effects["diffraction"].basis == "pilot"


@pytest.mark.filterwarnings("ignore::torchdic.ToleranceWarning", "ignore::torchdic.SamplingWarning")
def test_light_that_straight_rays_cannot_carry_is_planned_for_the_wave():
    """An index below the light's transverse momentum, where absorption lets the wave through."""
    grid = Grid((8, 16, 16), (0.05, 0.2, 0.2))
    delta = torch.full(grid.shape, -0.67)
    layer = volume(delta, grid, absorption=torch.full(grid.shape, 0.01))
    made = plan(layer, Microscope(0.546, Objective(0.9), Condenser(0.75)), Acquisition([None]), 0.2)
    assert made.fidelity.propagation == "wave"
    assert by_name(made)["bending"].needed


def test_shears_may_be_whole_numbers():
    grid = Grid((4, 24, 24), (0.4, 0.2, 0.2))
    scene = volume(GaussianBall(0.4, 0.02, 1.36).delta(grid), grid)
    whole, real = (plan(scene, MICROSCOPE, Acquisition([Prism((0, one), 1)], [6]), 0.1) for one in (1, 1.0))
    assert (whole.fidelity, whole.error) == (real.fidelity, real.error)


def test_specimens_one_voxel_wide_reach_the_sides_and_stay_cylinders():
    grid = Grid((8, 1, 60), (0.4, 0.2, 0.2))
    cylinder = volume(GaussianBall(0.8, 0.02, 1.36).delta(grid), grid)
    acquisition = Acquisition([Prism((0.1, 0.15), math.pi / 2)], [0.0, 1.0])
    found = outcome(Scene(cylinder, 0.05, acquisition=acquisition, padding=0))
    assert found.made.fidelity.padding == 0
    assert found.made.met
    assert found.error <= 0.05


@pytest.mark.parametrize(
    "condenser",
    [Condenser(0.78, inner_na=0.7), Condenser(0.765), Condenser(1.1)],
)
@pytest.mark.slow
def test_a_condenser_that_the_pupils_edge_divides_is_planned_for(condenser):
    grid = Grid((8, 48, 52), (0.4, 0.14, 0.14))
    ball = volume(GaussianBall(0.8, 0.02, 1.36).delta(grid), grid)
    microscope = Microscope(0.546, Objective(0.75), condenser)
    found = outcome(Scene(ball, 0.2, microscope, Acquisition([SHEARED])))
    assert found.made.met
    assert found.error <= 0.2


@pytest.mark.parametrize("tolerance", [pytest.param(0.05, marks=pytest.mark.slow), 0.02])
def test_an_edge_across_the_sides_of_a_wide_array_is_seen(tolerance):
    """A periodic array's last column is beside its first."""
    grid = Grid((5, 40, 120), (0.3, 0.2, 0.2))
    delta = torch.zeros(grid.shape)
    delta[1:4, :, 60:] = 0.005 * torch.sigmoid((torch.arange(60) - 12.0) / 4)
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.27))
    acquisition = Acquisition([SHEARED], [0.0, 1.0])
    found = outcome(Scene(volume(delta, grid), tolerance, microscope, acquisition, padding=0))
    assert found.made.met
    assert tolerance / 10 < found.error <= tolerance


def test_pixels_wider_than_a_pilots_window_are_planned_for():
    grid = Grid((4, 100, 100), (0.4, 0.2, 0.2))
    ball = volume(GaussianBall(0.8, 0.01, 1.36).delta(grid), grid)
    microscope = replace(MICROSCOPE, camera=Camera(pixel_size=13.0))
    assert by_name(plan(ball, microscope, Acquisition([SHEARED]), 0.1))["camera"].basis == "pilot"


def test_coherent_light_keeps_its_rings_far_beyond_the_sides():
    grid = Grid((8, 40, 44), (0.4, 0.2, 0.2))
    ball = volume(GaussianBall(0.8, 0.02, 1.36).delta(grid), grid)
    acquisition = Acquisition([Prism((0.1, 0.15), math.pi / 2)], [0.0, 1.0])
    with pytest.warns(ToleranceWarning):
        made = plan(ball, Microscope(0.546, Objective(0.1)), acquisition, 0.05)
    assert 0.06 < made.error < 0.12  # 0.074 against 150 voxels of padding


@pytest.mark.slow
@pytest.mark.parametrize("wavelength", [0.55, 0.6])
def test_slabs_carry_the_shortest_of_many_colours(wavelength):
    grid = Grid((4, 24, 24), (0.8, 0.12, 0.12))
    bead = volume(Bead(1.0, 0.25, 1.36).delta(grid), grid)
    microscope = Microscope(wavelength, Objective(0.6), Condenser(0.3), spectrum=Spectrum([0.4, 0.5, 0.6, 0.7, 0.8]))
    acquisition = Acquisition([SHEARED])
    made = plan(bead, microscope, acquisition, 0.3)
    assert bool(torch.isfinite(image(bead, microscope, acquisition, made.fidelity)).all())


@pytest.mark.slow
def test_a_spectrum_is_left_out_for_light_of_the_nominal_wavelength():
    ball = gaussian(0.02, 0.6)
    microscope = Microscope(0.5, Objective(0.6), Condenser(0.3), spectrum=Spectrum([0.5, 0.6, 0.61], [0, 1, 1]))
    acquisition = Acquisition([SHEARED], [1.0])
    found = by_name(plan(ball, microscope, acquisition, 0.05))["spectrum"]
    wave = Fidelity("wave", sources=32)
    with_, without = (image(ball, m, acquisition, wave) for m in (microscope, replace(microscope, spectrum=None)))
    assert found.error == pytest.approx(image_error(without, with_), rel=0.3)
    assert found.needed


# its manners


@pytest.mark.parametrize("tolerance", [0.011, *(pytest.param(t, marks=pytest.mark.slow) for t in (0.012, 0.013))])
def test_what_the_warning_says_to_ask_for_is_enough(tolerance):
    grid = Grid((8, 40, 44), (0.4, 0.2, 0.2))
    ball = volume(GaussianBall(0.8, 0.02, 1.36).delta(grid), grid)
    acquisition = Acquisition([Prism((0.1, 0.15), math.pi / 2)], [0.0, 1.0])
    with pytest.warns(ToleranceWarning) as warned:
        made = plan(ball, Microscope(0.546, Objective(0.1)), acquisition, tolerance)
    (asked,) = re.findall(r"ask for ([\d.]+),", str(warned[0].message))
    assert made.error <= PILOT_SHARE * float(asked) < 1.1 * made.error
    assert plan(ball, Microscope(0.546, Objective(0.1)), acquisition, float(asked)).met


def test_planning_is_the_same_each_time_and_leaves_no_graph():
    scene = coherent()
    learned = torch.nn.Parameter(scene.volume.delta.clone())
    made = plan(Volume(scene.volume.grid, learned, 1.36), scene.microscope, scene.acquisition, 0.02)
    again = plan(scene.volume, scene.microscope, scene.acquisition, 0.02)
    assert (made.fidelity, made.effects, made.error) == (again.fidelity, again.effects, again.error)
    assert learned.grad is None
    assert made.seconds > 0


def test_what_cannot_be_met_is_warned_of_with_what_to_ask_for():
    scene = coherent()
    with pytest.warns(ToleranceWarning, match=r"tolerance 1e-09, which takes .* 6e-10: the best errs by about"):
        made = plan(scene.volume, scene.microscope, scene.acquisition, 1e-9)
    assert not made.met
    assert "misses" in made.table()


@pytest.mark.parametrize("tolerance", [0.0, -1.0, math.inf, math.nan])
def test_a_tolerance_is_above_0_and_finite(tolerance):
    with pytest.raises(ValueError, match=r"tolerance .* must be above 0, and finite"):
        plan(coherent().volume, MICROSCOPE, ACQUISITION, tolerance)


@pytest.mark.slow
def test_a_window_of_layers_has_no_edges_of_its_own():
    """Layers wider than a pilot's window scatter nothing, so that one source and one slab do."""
    grid = Grid((8, 96, 90), (0.4, 0.2, 0.2))
    delta = (0.02 * torch.sin(grid.coordinates(0)))[:, None, None].expand(grid.shape)
    scene = Scene(volume(delta, grid), 0.03, padding=0)
    window = pilots.Scene(scene.volume, scene.microscope, scene.acquisition).window().volume
    assert window.grid.shape[1:] == (64, 64)
    assert torch.allclose(window.delta, scene.volume.delta[:, :64, :64], rtol=1e-6)
    made = scene.plan()
    assert (made.fidelity.sources, made.fidelity.steps) == (1, 1)
    assert image_error(scene.image(made.fidelity), scene.truth(made)) < scene.tolerance


def test_a_large_volume_is_judged_by_its_busiest_window():
    """Two specimens of unequal contrast, the pilot must see the stronger."""
    grid = Grid((6, 160, 40), (0.5, 0.2, 0.2))
    strong = GaussianBall(0.8, 0.05, 1.36, (0.0, 9.0, 0.0)).delta(grid)
    weak = GaussianBall(0.8, 0.0005, 1.36, (0.0, -9.0, 0.0)).delta(grid)
    microscope = replace(MICROSCOPE, condenser=None)
    scene = Scene(volume(strong + weak, grid), 0.02, microscope, Acquisition([SHEARED], [0.0]))
    assert outcome(scene).error <= scene.tolerance


# the command line, and reconstructions

CONFIG = {
    "tolerance": 0.2,
    "volume": {"shape": [5, 14, 12], "spacing": [0.5, 0.2, 0.21], "background": 1.5},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.7}, "condenser": {"na": 0.4}},
    "acquisition": {"focus": [-1.0, 1.0], "prisms": [{"shear": [0.0, 0.24], "bias": 1.5}]},
    "reconstruction": {"steps": 12, "checkpoint_every": 2},
    "specimen": {"kind": "gaussian_ball", "sigma": 0.5, "contrast": 0.02},
    "data": {"path": "out/stack.ome.tif"},
}


ADAM = {"method": "adam", "steps": 8, "checkpoint_every": 2, "start": "zero", "learning_rate": 2e-3, "tv": [60.0, 5.0]}


@pytest.fixture
def write(tmp_path):
    """A function from changes of the configuration to its file; None takes a key away."""

    def put(**changes):
        path = tmp_path / "config.toml"
        values = {k: v for k, v in {**CONFIG, **changes}.items() if v is not None}
        path.write_text(tomli_w.dumps(values), encoding="utf-8")
        return path

    return put


def run(*arguments):
    return main([str(a) for a in arguments])


def test_tolerance_is_read_from_the_file_and_written_back(write, tmp_path):
    config = load(write())
    assert (config.tolerance, config.fidelity) == (0.2, None)
    path = tmp_path / "again.toml"
    path.write_text(dump(config), encoding="utf-8")
    assert load(path).tolerance == 0.2
    assert load(write(tolerance=None)).tolerance is None


@pytest.mark.filterwarnings("ignore")
def test_plan_prints_its_table_and_leaves_it_as_json(write, tmp_path, capsys):
    assert run("plan", write()) == 0
    printed = capsys.readouterr().out
    assert "error without" in printed
    assert "partial coherence" in printed
    assert run("plan", write(), "--out", tmp_path / "planned") == 0
    kept = json.loads((tmp_path / "planned" / "plan.json").read_text(encoding="utf-8"))
    assert {effect["name"] for effect in kept["effects"]} >= {"bending", "camera"}
    Fidelity(**kept["fidelity"])


@pytest.mark.parametrize(
    ("command", "changes", "words"),
    [
        ("plan", {"specimen": None, "data": None}, "missing key specimen or data.path"),
        ("plan", {"tolerance": -1.0}, "tolerance -1.0 must be above 0, and finite"),
        ("plan", {"tolerance": "fine"}, "'fine' must be a number"),
        ("simulate", {"fidelity": {"sources": 3}}, "tolerance 0.2 and [fidelity] exclude each other"),
        ("reconstruct", {"fidelity": {"sources": 3}}, "tolerance 0.2 and [fidelity] exclude each other"),
        ("simulate", {"simulation": {"exact": True}}, "leaves nothing to plan"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(write, tmp_path, capsys, command, changes, words):
    assert run(command, write(**changes), "--out", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "recipe", [CONFIG["reconstruction"], pytest.param(ADAM, marks=pytest.mark.slow)], ids=["newton", "adam"]
)
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore")
def test_simulate_and_reconstruct_run_what_the_plan_says_and_say_so(write, tmp_path, capsys, recipe):
    path = write(reconstruction=recipe)
    assert run("simulate", path, "--out", tmp_path / "out") == 0
    assert "planned for 0.2" in capsys.readouterr().out
    resolved = tomllib.loads((tmp_path / "out" / "config.resolved.toml").read_text(encoding="utf-8"))
    assert resolved["fidelity"] | {"memory": 0} == {
        k: v for k, v in json.loads((tmp_path / "out" / "plan.json").read_text())["fidelity"].items() if v is not None
    } | {"memory": 0}

    assert run("reconstruct", path, "--out", tmp_path / "fit") == 0
    plans = json.loads((tmp_path / "fit" / "metrics.json").read_text())["plans"]
    if recipe is ADAM:
        assert plans[0]["step"] == 1
        assert len(plans) > 1  # from an empty volume it grows
    else:
        assert plans[0]["step"] == COARSE_STEPS + 1  # the coarse steps need none
    strengths = [made["strength"] for made in plans]
    assert all(b >= GROWTH * a for a, b in pairwise(strengths))
    text = (tmp_path / "fit" / "config.resolved.toml").read_text(encoding="utf-8")
    assert text.startswith(f"# planned at step {plans[0]['step']}: ")
    assert tomllib.loads(text)["tolerance"] == 0.2


@pytest.mark.parametrize("recipe", [CONFIG["reconstruction"], ADAM], ids=["newton", "adam"])
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_a_planned_reconstruction_goes_on_bit_for_bit(write, tmp_path, monkeypatch, recipe):
    path = write(reconstruction=recipe)
    assert run("simulate", path, "--out", tmp_path / "out") == 0
    assert run("reconstruct", path, "--out", tmp_path / "whole") == 0
    original = recorded.minimise

    def minimise(*arguments):
        for step in original(*arguments):
            if step.number == 4:  # after a plan, or before it
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(recorded, "minimise", minimise)
    assert run("reconstruct", path, "--out", tmp_path / "parts") == 130
    monkeypatch.setattr(recorded, "minimise", original)
    assert run("reconstruct", path, "--out", tmp_path / "parts", "--resume") == 0
    parts, whole = (read_volume(tmp_path / folder / "volume.ome.tif")[0] for folder in ("parts", "whole"))
    assert torch.equal(parts, whole)
    plans = [json.loads((tmp_path / folder / "metrics.json").read_text())["plans"] for folder in ("whole", "parts")]
    assert plans[0] == plans[1]


@pytest.mark.filterwarnings("ignore")
def test_a_volume_is_planned_again_only_once_it_has_doubled():
    grid = Grid((5, 14, 12), (0.5, 0.2, 0.21))
    delta = GaussianBall(0.5, 0.01, 1.5).delta(grid, dtype=torch.float32)

    def followed(plans, step, factor):
        return follow(plans, step, Setup(Volume(grid, factor * delta, 1.5), MICROSCOPE, ACQUISITION), 0.2)

    first = followed((), 0, 1)
    assert followed(first, 3, 1.99) == first
    second = followed(first, 5, 2.01)
    assert second[:1] == first
    assert [made["step"] for made in second] == [1, 6]
    assert isinstance(current(second), Fidelity)


def test_strength_is_the_index_or_the_path_whichever_is_more():
    grid = Grid((10, 4, 4), (0.5, 0.2, 0.2))
    assert strength(torch.zeros(grid.shape), grid, 0.5) == 1
    assert strength(torch.full(grid.shape, 0.004), grid, 0.5) == pytest.approx(4.0)  # by |Δn|, OPD 0.02 µm: 2
    assert strength(torch.full((100, 4, 4), 0.004), Grid((100, 4, 4), (0.5, 0.2, 0.2)), 0.5) == pytest.approx(20.0)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore")
def test_without_a_specimen_the_stacks_linear_estimate_is_planned_on(write, tmp_path, capsys):
    """Its plan is that of the specimen: the effects that matter are those of a volume as strong as it is."""
    assert run("simulate", write(), "--out", tmp_path / "out") == 0
    assert run("plan", write(), "--out", tmp_path / "known") == 0
    path = write(specimen=None, data={"path": str(tmp_path / "out" / "stack.ome.tif")})
    assert run("plan", path, "--out", tmp_path / "seen") == 0
    assert "planned on the linear estimate" in capsys.readouterr().out
    known, seen = (json.loads((tmp_path / name / "plan.json").read_text()) for name in ("known", "seen"))
    assert seen["fidelity"]["propagation"] == known["fidelity"]["propagation"]
    assert seen["met"]
    resolved = tomllib.loads((tmp_path / "seen" / "config.resolved.toml").read_text(encoding="utf-8"))
    assert resolved["data"]["path"].endswith("stack.ome.tif")
    assert run("plan", write(specimen=None, data=None)) == 2
    assert "missing key specimen or data.path" in capsys.readouterr().err
