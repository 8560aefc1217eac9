"""The nuisances beside a given Δn: one Gauss–Newton step, whose Jacobian is made of few images.

The nuisances' entries mostly act on a single image, or on the images of a single prism or plane. All such entries are
moved at once; the difference of the images is then the Jacobian of each of them in its own images. Images of the same
volume that differ by their prisms alone are formed together, so that light is propagated through the volume once.

With the images I, the misfit's gradient g and curvature c by each pixel, and the Jacobian J, a step solves
    (Jᵀ c J + damping) step = −Jᵀ g
(K. Levenberg, Quart. Appl. Math. 2, 164, 1944).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.fit.unknowns import with_values
from recon.misfit.base import Misfit
from torchdic import Fidelity
from torchdic.scalar import number

# A parameter's scale is this many of its steps. A nuisance moves by LONGEST scales at most.
SCALE, LONGEST = 100.0, 3.0
# Damping: a share of the Hessian's diagonal, and a curvature per scale² that holds what the images say nothing of.
RELATIVE, ABSOLUTE = 1e-7, 1e-6
# How often a step that raises the misfit is halved before it is given up.
HALVINGS = 4


@torch.no_grad()
def refined(
    unknowns: Sequence[Nuisance],
    parameters: Mapping[str, Tensor],
    setup: Setup,
    misfit: Misfit,
    fidelity: Fidelity,
    images: Float[Tensor, "prism focus y x"] | None = None,
) -> dict[str, Tensor]:
    """The nuisances' parameters after one Gauss–Newton step, by name; as they were where no step lowers the misfit.

    unknowns: what is refined, in the order in which values are put into the setup. parameters: of each, by its name.
    setup: the current volume, and what is known; not yet the nuisances' values. misfit: holds the data.
    fidelity: of the images. images: `formed` of the setup with the current values, where the caller has them.

    The misfit of the result is never above that of the given parameters. Nothing is propagated but for unknowns that
    act on how images are formed: one propagation for those of the prisms, one for the focus, and one for each try.
    """
    if not unknowns:
        return {}
    now = {u.name: parameters[u.name].detach() for u in unknowns}
    current = _placed(unknowns, now, setup)
    sets = _moved_sets(unknowns, now, setup)
    anew = [moved for moved, forms in sets if forms]
    formed = _formed(([current] if images is None else []) + anew, fidelity)
    if images is None:
        images, *formed = formed
    model, rest = current.recorded(images), iter(formed)
    differences = [moved.recorded(next(rest) if forms else images) - model for moved, forms in sets]
    step = _gauss_newton(unknowns, now, differences, misfit, model)

    before = float(misfit(model))
    optical = any(u.forms for u in unknowns)
    for _ in range(HALVINGS + 1):
        tried = {name: now[name] + step[name] for name in now}
        placed = _placed(unknowns, tried, setup)
        after = float(misfit(placed.recorded(placed.formed(fidelity) if optical else images)))
        if after <= before:
            return tried
        step = {name: part / 2 for name, part in step.items()}
    return now


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


def _placed(unknowns: Sequence[Nuisance], parameters: Mapping[str, Tensor], setup: Setup) -> Setup:
    return with_values(unknowns, {u.name: u.value(parameters[u.name]) for u in unknowns}, setup)


def _moved_sets(
    unknowns: Sequence[Nuisance], parameters: Mapping[str, Tensor], setup: Setup
) -> list[tuple[Setup, bool]]:
    """For each unknown and each of its directions the setup one step along it, and whether images are formed anew."""
    values = {u.name: u.value(parameters[u.name]) for u in unknowns}
    return [
        (with_values(unknowns, values | {u.name: u.of_entries(u.told(p) + u.step * direction)}, setup), u.forms)
        for u, p in ((u, parameters[u.name]) for u in unknowns)
        for direction in u.directions(p)
    ]


def _formed(setups: Sequence[Setup], fidelity: Fidelity) -> list[Tensor]:
    """Each setup's formed images; those of the same specimen, microscope and planes are formed together."""
    together: dict[object, list[int]] = {}
    for index, setup in enumerate(setups):
        planes = tuple(number(focus) for focus in setup.acquisition.focus)
        together.setdefault((id(setup.volume), id(setup.microscope), planes), []).append(index)
    formed: dict[int, Tensor] = {}
    for members in together.values():
        first = setups[members[0]]
        prisms = [prism for index in members for prism in setups[index].acquisition.prisms]
        acquisition = replace(first.acquisition, prisms=prisms)
        bare = Setup(first.volume, first.microscope, acquisition)
        parts = bare.formed(fidelity).split(len(first.acquisition.prisms))
        formed |= dict(zip(members, parts, strict=True))
    return [formed[index] for index in range(len(setups))]


def _gauss_newton(
    unknowns: Sequence[Nuisance],
    parameters: Mapping[str, Tensor],
    differences: Sequence[Tensor],
    misfit: Misfit,
    model: Float[Tensor, "prism focus y x"],
) -> dict[str, Tensor]:
    """The damped Gauss–Newton step of each parameter. differences: of the images, one for each unknown's direction."""
    with torch.enable_grad():
        images = model.detach().clone().requires_grad_()
        (slope,) = torch.autograd.grad(misfit(images), images)
    curvature = misfit.curvature(model)
    # per image: the products of its directions (prism, focus, direction, direction), and their slopes
    products = [torch.stack([_sums(a * curvature, b) for b in differences], -1) for a in differences]
    gram, slopes = torch.stack(products, -2), torch.stack([_sums(slope, a) for a in differences], -1)

    # from the parameters, in their scales, to the directions in units of the differences' steps
    acting, scale = _acting(unknowns, parameters, (model.shape[0], model.shape[1]))
    acting = acting * SCALE
    hessian = acting.mT @ (gram @ acting.unflatten(0, gram.shape[:3])).flatten(0, 2)
    gradient = acting.mT @ slopes.flatten()
    damped = hessian + torch.diag(RELATIVE * hessian.diagonal() + ABSOLUTE)
    step = -torch.linalg.solve(damped, gradient)
    step = step * scale * min(1.0, LONGEST / max(float(step.abs().max()), 1e-300))
    parts = step.split([parameters[u.name].numel() for u in unknowns])
    return {
        u.name: part.reshape(parameters[u.name].shape).to(parameters[u.name])
        for u, part in zip(unknowns, parts, strict=True)
    }


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
