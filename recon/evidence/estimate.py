"""A volume that was fitted, and how to fit the same again to other images."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.bounds import Bounds
from recon.fit.descent import solved
from recon.fit.problem import Problem, measured_noise
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, Unknown, with_values
from recon.misfit.base import Misfit, UniformImagesError
from recon.recording.noise import NoiseModel, noise_of_level


@dataclass(frozen=True, eq=False)
class Estimate:
    """A volume that was fitted to images, and all that it takes to fit the same again to others.

    problem: that was solved. step: its last. noise: standard deviation of each pixel (broadcastable) of given images
    (prism, focus, y, x). misfit: makes one from images. solve: solves a problem.
    """

    problem: Problem
    step: Step
    noise: Callable[[Tensor], Tensor]
    misfit: Callable[[Tensor], Misfit]
    solve: Callable[[Problem], Step]

    @classmethod
    def of_fit(
        cls,
        problem: Problem,
        step: Step | None = None,
        noise: NoiseModel | Sequence[float] | None = None,
        solve: Callable[[Problem], Step] = solved,
    ) -> "Estimate":
        """The estimate that a fit ended with.

        problem: that was fitted. step: the last; None fits now. noise: of the images, in the unit of the data: shot and
        read noise, or the standard deviation of each prism's; None is measured in them. solve: solves a problem.
        Raises, before any fit, ValueError where the noise can't be measured or isn't one number of at least 0 for each
        prism, and NotImplementedError for a misfit that can't be made of other images.
        """
        deviation = _pixels_noise(problem.misfit, noise)
        problem.misfit.again(problem.misfit.data)
        return cls(problem, solve(problem) if step is None else step, deviation, problem.misfit.again, solve)

    @property
    def delta(self) -> Float[Tensor, "z y x"]:
        """Δn of the whole volume, with its margin."""
        return self.step.delta

    @torch.no_grad()
    def images(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "prism focus y x"]:
        """The images of another Δn, with everything else as it was found."""
        values = {**self.step.values, IndexDifference.name: delta}
        known = {name: value.to(self.problem.misfit.data.device) for name, value in values.items()}
        setup = with_values(self.problem.unknowns, known, self.problem.setup)
        return setup.images(self.problem.fidelity.last(self.step.plans))

    def recorded(self, images: Float[Tensor, "prism focus y x"], seed: int) -> Float[Tensor, "prism focus y x"]:
        """The images with other noise of the same strength. seed: of the noise."""
        drawn = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed))
        return images + self.noise(images) * drawn.to(images)

    def of_other_images(
        self, images: Float[Tensor, "prism focus y x"], *, going_on: bool = False, anywhere: bool = False
    ) -> Problem | None:
        """The problem of other images, to be solved as that of the first ones was in the end.

        going_on: start from this estimate; else anew. anywhere: without a support, where the specimen is another one.
        None for images that are uniform: they show nothing.
        """
        try:
            misfit = self.misfit(images)
        except UniformImagesError:  # as where a dark field has no noise
            return None
        newton = self.problem.method == "newton"  # what Adam ends with depends on the number of its steps
        problem = self.problem.again(misfit, self.step, self.delta if going_on and newton else None)
        return _unsupported(problem) if anywhere else problem

    def refitted(
        self, images: Float[Tensor, "prism focus y x"], *, going_on: bool = False, anywhere: bool = False
    ) -> Float[Tensor, "z y x"]:
        """Δn of the whole volume by a fit of other images, see `of_other_images`; empty where these show nothing."""
        problem = self.of_other_images(images, going_on=going_on, anywhere=anywhere)
        return torch.zeros_like(self.delta) if problem is None else self.solve(problem).delta


def _pixels_noise(misfit: Misfit, told: NoiseModel | Sequence[float] | None) -> Callable[[Tensor], Tensor]:
    """The standard deviation of the noise at each pixel of given images. told: as in `Estimate.of_fit`."""
    if told is None:
        mask = None if misfit.mask is None else misfit.mask.cpu().numpy()
        told = noise_of_level(misfit.data.cpu().numpy(), mask) or measured_noise(misfit.data, misfit.mask)
    if told is None:
        raise ValueError("the noise of images so small can't be measured: there are no error bars without")
    if isinstance(told, NoiseModel):
        return lambda images: told.like(images).variance(images).sqrt()
    if len(told) != len(misfit.data):
        raise ValueError(f"the noise is given of {len(told)} prisms, the data have {len(misfit.data)}")
    for prism, level in enumerate(told):
        if not 0 <= level < math.inf:
            raise ValueError(f"the noise {level:g} of prism {prism + 1} must be at least 0 and finite")
    levels = torch.tensor(told)[:, None, None, None]
    return lambda images: levels.to(images)


def _unsupported(problem: Problem) -> Problem:
    """The problem with Δn sought everywhere."""

    def freed(unknown: Unknown) -> Unknown:
        if isinstance(unknown, IndexDifference):
            return replace(unknown, bounds=Bounds(unknown.bounds.lower, unknown.bounds.upper))
        return unknown

    return replace(problem, unknowns=[freed(unknown) for unknown in problem.unknowns])
