"""The error bars of a fit, from its problem alone."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from recon.evidence.bars import ErrorBars, bars_of
from recon.evidence.estimate import Estimate
from recon.evidence.refits import COPIES, NOISY, planned_refits, refits
from recon.evidence.regions import INCREMENT
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.recording.noise import NoiseModel


def error_bars(
    problem: Problem,
    step: Step | None = None,
    noise: NoiseModel | Sequence[float] | None = None,
    *,
    noisy: int = NOISY,
    copies: int = COPIES,
    increment: float = INCREMENT,
    outlines: Mapping[str, Bool[Tensor, "z y x"]] | None = None,
) -> ErrorBars:
    """Find how far each voxel of a fit, and the numbers of its parts, can be trusted.

    The fit's own images with other noise are fitted again, and turned copies of it, whose truth is known, are recorded
    and fitted: with the usual numbers of both that takes the time of some 13 to 18 fits.

    problem: that was fitted. step: the last of the fit, as `solved` returns it; None fits now.
    noise: of the images, in the unit of the data: the camera's, or the standard deviation of each prism's; None is
    measured in them.
    noisy: number of fits to other noise. copies: number of turned copies. At least 2 of each.
    increment: of the index with concentration, ml/g, by which dry mass is told.
    outlines: boolean volumes (z, y, x) by name, True within what is drawn around a part; what stands out in it is
    measured as the whole specimen is.
    Raises, before any fit, ValueError for fewer of them, an outline of another shape, and noise that can't be measured
    or isn't one number of at least 0 for each prism, and NotImplementedError for a misfit that can't be made of other
    images; and what `minimise` raises.
    """
    for name, number in (("noisy", noisy), ("copies", copies)):
        if number < 2:
            raise ValueError(f"{name} {number} must be at least 2: one fit tells no spread")
    field = problem.setup.field.shape
    for name, outline in (outlines or {}).items():
        if tuple(outline.shape) != field or outline.dtype != torch.bool:
            given = f"{outline.dtype} of shape {tuple(outline.shape)}"
            raise ValueError(f"the outline {name!r} is {given}, it must be torch.bool of the field's {field} (z, y, x)")
    estimate = Estimate.of_fit(problem, step, noise)
    return bars_of(estimate, list(refits(estimate, planned_refits(noisy, copies))), increment, outlines)
