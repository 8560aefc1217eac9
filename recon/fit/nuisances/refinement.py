"""The nuisances beside a given Δn: a few Gauss–Newton steps with the images of few propagations.

With the images I, the misfit's gradient g and curvature c by each pixel, and the Jacobian J, a step solves
    (Jᵀ c J + P + damping) step = −Jᵀ g − P p
where P is what is known of the parameters p beforehand: 1/width² in the unit of half the noise's χ², which is the
misfit over the number of pixels, as if all of it were noise.
(K. Levenberg, Quart. Appl. Math. 2, 164, 1944). The steps are taken on the images of `recon.fit.nuisances.nearby`, and
the last of them is then judged by images that are formed anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.nuisances.nearby import Nearby
from recon.fit.setup import Setup
from recon.misfit.base import Misfit
from torchdic import Fidelity

# A parameter's scale is this many of its steps. No entry moves by more than LONGEST scales at once.
SCALE, LONGEST = 10.0, 1.5
# Damping: a share of the Hessian's diagonal, and a curvature per scale² that holds what the images say nothing of.
RELATIVE, ABSOLUTE = 1e-7, 1e-6
# Steps on the nearby images, fewer once they are shorter than this many scales; so short a way isn't gone at all.
STEPS, SHORT = 5, 1e-3
# How often a step that raises the misfit is halved before it is given up.
HALVINGS = 4
# Differences of images of less than this many times their dtype's eps are those of rounding.
ROUNDING = 8.0

Parameters = dict[str, Tensor]


@torch.no_grad()
def refined(
    unknowns: Sequence[Nuisance],
    parameters: Mapping[str, Tensor],
    setup: Setup,
    misfit: Misfit,
    fidelity: Fidelity,
    images: Float[Tensor, "prism focus row column"] | None = None,
) -> Parameters:
    """The nuisances' parameters with which the images of a given Δn are closer to the data, by name.

    unknowns: what is refined, in the order in which values are put into the setup. parameters: of each, by its name.
    setup: the current volume, and what is known; not yet the nuisances' values. misfit: holds the data.
    fidelity: of the images. images: `formed` of the setup with the current values, where the caller has them.

    The misfit of the result, with what the parameters' widths add to it, is never above that of the given parameters,
    which are returned where nothing lowers it.
    Images are formed for unknowns alone that act on how they are formed: with one propagation for all those of the
    prisms, one for the focus, and one for each try, which is one as a rule.
    """
    before = {u.name: parameters[u.name].detach() for u in unknowns}
    if not unknowns:
        return before
    nearby = Nearby(unknowns, before, setup, fidelity, images)
    objective = Beforehand.at(nearby, before, misfit)
    found = before
    for _ in range(STEPS):
        objective = Beforehand.at(nearby, found, misfit)  # the better the fit, the less of what is left is noise
        step, length = _gauss_newton(nearby, found, objective)
        following = _lowered(nearby, found, step, objective)
        if following is None:
            break
        found = following
        if length < SHORT:
            break
    return _judged(nearby, found, objective, fidelity) if nearby.bends else found


@torch.no_grad()
def best_brightness(images: Float[Tensor, "prism focus y x"], misfit: Misfit) -> Float[Tensor, "prism focus"]:
    """The factor of each image (prism, focus) with which it is closest to the data; 1 where nothing tells it.

    images: (prism, focus, y, x), of brightness 1. misfit: holds the data, and weights a pixel by its curvature at these
    images. Weighted least squares, Σ w·d·I / Σ w·I²; it is the minimum of a Gaussian misfit.
    """
    weighted = misfit.curvature(images) * images
    norm = (weighted * images).sum((2, 3), dtype=torch.float64)
    found = (weighted * misfit.data).sum((2, 3), dtype=torch.float64) / torch.where(norm > 0, norm, 1)
    return torch.where(norm > 0, found, 1).to(images)


@dataclass(frozen=True, eq=False)
class Beforehand:
    """A misfit, and what is known of the parameters beforehand.

    unknowns: whose parameters these are. unit: of half a χ² in the misfit.
    """

    unknowns: Sequence[Nuisance]
    misfit: Misfit
    unit: float

    @classmethod
    def at(cls, nearby: Nearby, parameters: Mapping[str, Tensor], misfit: Misfit) -> "Beforehand":
        """As if all of the misfit with these parameters were noise."""
        value = float(misfit(nearby.recorded(parameters)))
        return cls(nearby.unknowns, misfit, 2 * value / float(misfit.pixels.sum()))

    def __call__(self, images: Tensor, parameters: Mapping[str, Tensor]) -> float:
        """The misfit of images, and how far their parameters lie outside their widths."""
        outside = sum(
            float((u.told(parameters[u.name]) / u.width).square().sum()) for u in self.unknowns if u.width is not None
        )
        return float(self.misfit(images)) + self.unit / 2 * outside

    def pull(self, parameters: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Second and first derivative of the widths' part by each entry, in the entries' scales, float64."""
        parts = []
        for u in self.unknowns:
            told = u.told(parameters[u.name]).flatten().double()
            factor = 0.0 if u.width is None else self.unit * (SCALE * u.step / u.width) ** 2
            parts.append((torch.full_like(told, factor), factor * told / (SCALE * u.step)))
        return torch.cat([second for second, _ in parts]), torch.cat([first for _, first in parts])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """How a misfit depends on all parameters' entries near a place, in their scales.

    hessian: (entry, entry), as Gauss and Newton have it. slopes: the gradient, image by image (image, entry).
    scatter: the sum over all pixels of the squares of their parts in the gradient (entry, entry), where it was asked
    for. scale: of each entry. held, pull: second and first derivative of what is known of each entry beforehand.
    unit: see `Beforehand`.
    """

    hessian: Float[Tensor, "entry entry"]
    slopes: Float[Tensor, "image entry"]
    scatter: Float[Tensor, "entry entry"] | None
    scale: Float[Tensor, " entry"]
    held: Float[Tensor, " entry"]
    pull: Float[Tensor, " entry"]
    unit: float

    @property
    def damped(self) -> Float[Tensor, "entry entry"]:
        """The Hessian with what is known beforehand, and the damping of what nothing is known of."""
        return self.hessian + torch.diag(self.held + RELATIVE * self.hessian.diagonal() + ABSOLUTE)

    def step(self) -> Float[Tensor, " entry"]:
        """The damped step, in the entries' scales."""
        return -torch.linalg.solve(self.damped, self.slopes.sum(0) + self.pull)


@torch.no_grad()
def normal_equations(
    nearby: Nearby, parameters: Mapping[str, Tensor], objective: Beforehand, scattered: bool = False
) -> NormalEquations:
    """The normal equations at parameters near those of the nearby images; their entries in the order of its unknowns.

    scattered: whether the scatter is asked for.
    """
    misfit = objective.misfit
    model = nearby.recorded(parameters)
    columns = [_told_from_rounding(column, model) for column in nearby.jacobian(parameters)]
    with torch.enable_grad():
        leaf = model.clone().requires_grad_()
        (slope,) = torch.autograd.grad(misfit(leaf), leaf)
    curvature = misfit.curvature(model)
    # from the parameters in their scales to the directions in their steps
    acting, scale = _acting(nearby.unknowns, parameters, (model.shape[0], model.shape[1]))
    by_image = (acting * SCALE).unflatten(0, (*model.shape[:2], -1))

    def of_entries(weight: Tensor) -> Tensor:
        # per image: the products of its directions (prism, focus, direction, direction)
        products = [torch.stack([_sums(a * weight, b) for b in columns], -1) for a in columns]
        return (by_image.mT @ torch.stack(products, -2) @ by_image).sum((0, 1))

    slopes = torch.stack([_sums(slope, a) for a in columns], -1)[..., None, :] @ by_image
    scatter = of_entries(slope.square()) if scattered else None
    held, pull = objective.pull(parameters)
    return NormalEquations(of_entries(curvature), slopes.flatten(0, 2), scatter, scale, held, pull, objective.unit)


def _gauss_newton(nearby: Nearby, parameters: Parameters, objective: Beforehand) -> tuple[Parameters, float]:
    """The damped Gauss–Newton step of each parameter, and its longest entry in scales."""
    equations = normal_equations(nearby, parameters, objective)
    step = equations.step()
    parts = (step * equations.scale).split([part.numel() for part in parameters.values()])
    shaped = {
        name: part.reshape(parameter.shape).to(parameter)
        for (name, parameter), part in zip(parameters.items(), parts, strict=True)
    }
    return shaped, float(step.abs().max())


def _lowered(nearby: Nearby, parameters: Parameters, step: Parameters, objective: Beforehand) -> Parameters | None:
    """The parameters after the step, or a half, a quarter, … of it; None where all raise the objective."""
    before = objective(nearby.recorded(parameters), parameters)
    most = {u.name: LONGEST * SCALE * u.step for u in nearby.unknowns}
    for halving in range(HALVINGS + 1):
        tried = {}
        for name, start in nearby.parameters.items():
            away = parameters[name] + step[name] / 2**halving - start
            tried[name] = start + away.clamp(-most[name], most[name])
        if objective(nearby.recorded(tried), tried) <= before:
            return tried
    return None


def _judged(nearby: Nearby, found: Parameters, objective: Beforehand, fidelity: Fidelity) -> Parameters:
    """What was found, or half of the way there, …, such that the objective by newly formed images doesn't grow."""
    start = nearby.parameters
    scales = {u.name: SCALE * u.step for u in nearby.unknowns}
    if max(float((found[name] - part).abs().max()) / scales[name] for name, part in start.items()) < SHORT:
        return dict(start)  # new images would tell their rounding alone
    before = objective(nearby.recorded(start), start)
    for halving in range(HALVINGS + 1):
        tried = {name: part + (found[name] - part) / 2**halving for name, part in start.items()}
        if objective(nearby.placed(tried).images(fidelity), tried) <= before:
            return tried
    return dict(start)


def _told_from_rounding(difference: Tensor, model: Tensor) -> Tensor:
    """The difference of images, 0 where it is no more than their rounding, as that by drift without contrast."""
    rounding = ROUNDING * torch.finfo(model.dtype).eps * _sums(model, model).sqrt()
    return torch.where((_sums(difference, difference).sqrt() > rounding)[..., None, None], difference, 0)


def _acting(
    unknowns: Sequence[Nuisance], parameters: Mapping[str, Tensor], images: tuple[int, int]
) -> tuple[Float[Tensor, "row entry"], Float[Tensor, " entry"]]:
    """How far each entry of all parameters moves each image along each direction, and the entries' scales.

    The rows are (prism, focus, direction of any unknown), the columns the entries of one parameter after another.
    """
    blocks = [u.acting(parameters[u.name], images) for u in unknowns]
    rows, columns = (sum(block.shape[axis] for block in blocks) for axis in (2, 3))
    whole = blocks[0].new_zeros(*images, rows, columns)
    row = column = 0
    for block in blocks:
        height, width = block.shape[2:]
        whole[:, :, row : row + height, column : column + width] = block
        row, column = row + height, column + width
    scales = [whole.new_full((parameters[u.name].numel(),), SCALE * u.step) for u in unknowns]
    return whole.flatten(0, 2), torch.cat(scales)


def _sums(a: Tensor, b: Tensor) -> Float[Tensor, "prism focus"]:
    """Sum of a product over each image, in float64."""
    return (a * b).sum((2, 3), dtype=torch.float64)
