"""The minimum of a quadratic model plus priors with corners, within bounds: by ADMM.

    minimise ½x·Bx − q·x + Σ edges·|Dx| + sparse·|x| + rough·½|Dx|²,   lower ≤ x ≤ upper

D is the gradient at each of the prior's corners of the voxels, of which the sum is a mean. Dx and a copy y of x are
variables of their own, with multipliers u and v (scaled), so that each term that isn't smooth is met by a closed form
and x by one linear solve (S. Boyd et al., Foundations and Trends in Machine Learning 3, 1, 2011, 6.4).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.bounds import Bounds
from recon.fit.newton.differences import adjoint_differences, at_corner, forward_differences, from_corner
from recon.prior.base import Majorant
from recon.prior.edges import CORNERS

# Rounds in each model. The multipliers go on from one model to the next.
ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Split:
    """Where ADMM stands. free: x. edges, copy: the multipliers u and v, over their penalties."""

    free: Float[Tensor, "z y x"]
    edges: Float[Tensor, "corner 3 z y x"]
    copy: Float[Tensor, "z y x"]

    @classmethod
    def at(cls, delta: Float[Tensor, "z y x"]) -> "Split":
        """Anew, at a volume."""
        return cls(delta, delta.new_zeros(len(CORNERS), 3, *delta.shape), torch.zeros_like(delta))


@dataclass(frozen=True)
class Penalties:
    """How strongly ADMM ties the differences (edges) and the copy to x."""

    edges: float
    copy: float


def minimised(
    solve: Callable[[Float[Tensor, "z y x"]], Float[Tensor, "z y x"]],
    right: Float[Tensor, "z y x"],
    majorant: Majorant,
    bounds: Bounds,
    split: Split,
    penalties: Penalties,
    ratio: float,
) -> tuple[Float[Tensor, "z y x"], Split]:
    """Δn after ROUNDS rounds, within the bounds, and where they ended.

    solve: (B + rough·DᵀD + edges·DᵀD + copy)⁻¹ with the penalties' edges and copy. right: q. ratio: spacing along x
    over that along z.
    """
    free, u, v = split.free, split.edges.clone(), split.copy
    shrink = torch.as_tensor(majorant.edges).to(free).expand(len(CORNERS), *free.shape) / penalties.edges
    threshold = majorant.sparse / penalties.copy
    delta = free
    for _ in range(ROUNDS):
        differences = forward_differences(free, ratio)
        pull = torch.zeros_like(differences)
        for corner, weight, multiplier in zip(CORNERS, shrink, u, strict=True):
            raised = at_corner(differences, corner).add_(multiplier)
            length = raised.square().sum(0).sqrt_().clamp_min_(torch.finfo(free.dtype).tiny)
            edges = raised * (1 - weight / length).clamp_min_(0)
            torch.sub(raised, edges, out=multiplier)
            pull += from_corner(edges.sub_(multiplier), corner)
        lifted = free + v
        delta = bounds.clamped(lifted.sign() * (lifted.abs() - threshold).clamp_min(0))
        v = lifted - delta
        pulled = adjoint_differences(pull, ratio).mul_(penalties.edges / len(CORNERS))
        free = solve(right + pulled.add_(delta - v, alpha=penalties.copy))
    return delta, Split(free, u, v)
