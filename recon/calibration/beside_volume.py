"""What an unknown specimen tells of the optics: values with which a volume that is fitted explains its images best.

The direction of the shear and the condenser's aperture show so. Of bias b and length s of the shear their product
s·cot(b/2) does, faintly: it is how strong the differential part of an image is beside the part that a bright field has
too, which out of focus shows a specimen's Δn without any prism. Two settings tell the parts apart, one doesn't.
Brightness and drift of each image show beside any volume.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from recon.calibration.optics import CondenserAperture, ShearOfAxes, axes_of
from recon.calibration.part import Part
from recon.calibration.trials.profile import Least, least_misfit
from recon.calibration.trials.short_fits import last_step, unwarned
from recon.calibration.uncertainty import standard_deviations
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.light import Brightness
from recon.fit.nuisances.nearby import Nearby
from recon.fit.nuisances.refinement import refined
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup
from recon.fit.step import Step
from recon.fit.unknowns import with_values
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Fidelity
from torchdic.ranks.each import each

# Steps and condenser directions of a fit.
STEPS, SOURCES = 8, 18

# The part of the priors' weight beside which brightness and drift are told.
LIGHT = 0.25

# Of a fit that leaves little but noise: its steps, its condenser directions, and those of its drafts.
CAREFUL = {"steps": 14, "sources": 72, "drafts": 32}

# Distance of the trials: of the shear's angle in rad, of the logarithms of the condenser's NA and the shear's length.
ANGLE, APERTURE, LENGTH = 0.12, 0.12, 0.15


@dataclass(frozen=True, eq=False)
class Beside:
    """A part of a stack, and how a volume is fitted to it.

    setup: an empty volume before the part. recipe: how to fit. noise: standard deviation of each prism's. weight: of
    the priors; None follows the noise. steps, sources, drafts: of a fit, see `recon.calibration.trials.short_fits`.
    """

    part: Part
    setup: Setup
    recipe: Recipe
    noise: Sequence[float]
    weight: float | None = None
    steps: int = STEPS
    sources: int = SOURCES
    drafts: int | None = None

    @property
    def misfit(self) -> GaussianMisfit:
        """Of the part's images."""
        return GaussianMisfit(self.part.data, mask=self.part.mask)

    @property
    def alone(self) -> float:
        """What noise leaves of the misfit."""
        return self.misfit.of_noise(self.noise) or 0.0

    def held(self) -> "Beside":
        """The same with the priors' weight held at what it comes to now: trials differ by it else."""
        weights = self.last(self.problem(self.setup)).weights
        return self if not weights else replace(self, weight=float(weights[-1]["tv"]))

    def problem(self, setup: Setup) -> Problem:
        """The fit of a volume with these optics."""
        recipe = self.recipe
        if self.weight is not None:
            recipe = recipe.held(self.weight)
        fidelity, mask = Fidelity("wave", sources=self.sources), self.part.mask
        return Problem.from_recipe(
            self.part.data, setup, fidelity, recipe, lambda data: GaussianMisfit(data, mask=mask), list(self.noise)
        )

    def careful(self) -> "Beside":
        """The same by fits that leave little but noise, with the priors' weight held at what it comes to."""
        return replace(self, weight=None, **CAREFUL).held()

    def last(self, problem: Problem) -> Step:
        """The last step of a fit. Raises ValueError where the light can't be followed."""
        last = last_step(problem, self.steps, self.sources, self.drafts)
        if last is None:
            raise ValueError("no volume can be fitted with these optics")
        return last

    def misfits(self, setup: Setup) -> np.ndarray:
        """The misfit of each image, relative to its prism's spatial variance, after a fit."""
        problem = self.problem(setup)
        last = self.last(problem)
        with torch.no_grad(), unwarned():
            images = with_values(problem.unknowns, last.values, setup).images(Fidelity("wave", sources=self.sources))
        misfit = problem.misfit
        squares = misfit.where_counted((images - misfit.data).square()) / misfit.variance
        return squares.mean((2, 3)).flatten().double().numpy()

    def least(self, name: str, changed: Callable[[float], Setup], step: float, limits: tuple[float, float]) -> Least:
        """The change of the optics, 0 as declared, with the least misfit. name: of what is changed, for the user."""
        counted = int(self.misfit.pixels.sum())
        with tqdm(desc=name, unit="volume") as bar:

            def misfits_at(values: Sequence[float]) -> Iterator[np.ndarray]:
                for found in each(self.misfits, [changed(value) for value in values]):
                    bar.update()
                    yield found

            return least_misfit(misfits_at, 0.0, step, self.alone, counted, limits)


def find_angles(beside: Beside) -> list[Least]:
    """By how much the shear of each axis is turned from +x towards +y, rad; one axis after the other."""
    axes = axes_of(beside.setup.acquisition)
    unknown = ShearOfAxes(axes)
    turned = torch.zeros(max(axes) + 1, 2, dtype=torch.float64)
    found = []
    for axis in range(max(axes) + 1):

        def changed(angle: float, axis: int = axis) -> Setup:
            entries = turned.clone()
            entries[axis, 1] = angle
            return unknown.put(unknown.of_entries(entries), beside.setup)

        found.append(beside.least(f"shear's angle {axis + 1}", changed, ANGLE, (-0.8, 0.8)))
        turned[axis, 1] = found[-1].value
    return found


def find_aperture(beside: Beside) -> Least:
    """The logarithm of the condenser's NA over the declared one."""
    condenser = beside.setup.microscope.condenser
    assert condenser is not None
    unknown = CondenserAperture(float(beside.setup.volume.background))

    def changed(logarithm: float) -> Setup:
        return unknown.put(torch.tensor(logarithm, dtype=torch.float64).exp(), beside.setup)

    return beside.least("condenser's NA", changed, APERTURE, (-1.0, 0.7))


def find_length(beside: Beside) -> Least:
    """The logarithm of the shear's length over the declared one, of all settings alike, with the declared biases.

    What the images tell is the product s·cot(b/2), which the length changes here; see
    `recon.calibration.length_and_bias` for how the two share it.
    Where another one is found, it is sought once more beside that, because a wrong one gives the priors a wrong weight.
    """
    axes = axes_of(beside.setup.acquisition)
    unknown = ShearOfAxes(axes)

    def changed(logarithm: float) -> Setup:
        entries = torch.zeros(max(axes) + 1, 2, dtype=torch.float64)
        entries[:, 0] = logarithm
        return unknown.put(unknown.of_entries(entries), beside.setup)

    first = beside.careful().least("shear's length", changed, LENGTH, (-0.8, 0.8))
    if abs(first.value) <= first.deviation:
        return first
    near = replace(beside, setup=changed(first.value)).careful()
    again = near.least("shear's length", lambda more: changed(first.value + more), LENGTH / 2, (-0.4, 0.4))
    tried = tuple((first.value + more, misfit) for more, misfit in again.tried)
    return replace(again, value=first.value + again.value, tried=first.tried + tried)


def find_images(beside: Beside) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Brightness (prism, focus) and drift (prism, focus, 2) in µm beside a volume, and their deviations, by name.

    Priors draw a volume in, and a drift makes up for a part of what it lacks then. So the values are those beside a
    volume whose priors have a part of their usual weight, and how far they moved with it is in the deviations.
    """
    with tqdm(total=2, desc="brightness and drift", unit="volume") as bar:
        usual, _, weight = _images_found(beside)
        bar.update()
        found, deviations, _ = _images_found(beside if weight is None else replace(beside, weight=LIGHT * weight))
        bar.update()
    values, sure = {}, {}
    for unknown in (Brightness(), Drift()):
        name = unknown.name
        moved = unknown.told(found[name]) - unknown.told(usual[name])
        values[name] = unknown.value(found[name])
        sure[name] = (deviations[name].square() + moved.square()).sqrt()
    return values, sure


def _images_found(beside: Beside) -> tuple[dict[str, Tensor], dict[str, Tensor], float | None]:
    """The parameters of brightness and drift, their deviations beside the volume, and the priors' last weight."""
    problem = beside.problem(beside.setup)
    last = beside.last(replace(problem, unknowns=[*problem.unknowns, Drift()]))
    unknowns = [Brightness(), Drift()]
    others = [u for u in problem.unknowns if u.name != Brightness.name]
    setup = with_values(others, last.values, beside.setup)
    parameters = {"brightness": last.values["brightness"].log(), "drift": last.values["drift"]}
    fidelity = Fidelity("wave", sources=beside.sources)
    parameters = refined(unknowns, parameters, setup, problem.misfit, fidelity)
    nearby = Nearby(unknowns, parameters, setup, fidelity)
    deviations = standard_deviations(nearby, parameters, problem.misfit)
    return parameters, deviations, float(last.weights[-1]["tv"]) if last.weights else None
