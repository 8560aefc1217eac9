"""The gradient of `recon.prior.edges`, periodic along y and x, and its adjoint: Newton's method inverts them."""

import torch
from jaxtyping import Float
from torch import Tensor


def forward_differences(delta: Float[Tensor, "z y x"], ratio: float) -> Float[Tensor, "3 z y x"]:
    """Differences to the next voxel along z, times `ratio`, y and x.

    ratio: spacing along x over that along z. Along z the last difference is 0; y and x are periodic.
    """
    out = delta.new_zeros(3, *delta.shape)
    torch.sub(delta[1:], delta[:-1], out=out[0, :-1])
    out[0] *= ratio
    for axis in (1, 2):
        last = delta.shape[axis] - 1
        body, edge = out[axis].narrow(axis, 0, last), out[axis].narrow(axis, last, 1)
        torch.sub(delta.narrow(axis, 1, last), delta.narrow(axis, 0, last), out=body)
        torch.sub(delta.narrow(axis, 0, 1), delta.narrow(axis, last, 1), out=edge)
    return out


def adjoint_differences(vectors: Float[Tensor, "3 z y x"], ratio: float) -> Float[Tensor, "z y x"]:
    """The adjoint of `forward_differences`."""
    out = vectors.sum(0).neg_()
    out -= (ratio - 1) * vectors[0]
    out[1:] += ratio * vectors[0, :-1]
    out[-1] += ratio * vectors[0, -1]  # the last difference along z is no difference
    for axis in (1, 2):
        last = out.shape[axis] - 1
        out.narrow(axis, 1, last).add_(vectors[axis].narrow(axis, 0, last))
        out.narrow(axis, 0, 1).add_(vectors[axis].narrow(axis, last, 1))
    return out


def at_corner(differences: Float[Tensor, "3 z y x"], corner: tuple[int, int, int]) -> Float[Tensor, "3 z y x"]:
    """The gradient at one of the CORNERS, from the `forward_differences`."""
    return torch.stack(
        [along.roll(back, axis) for axis, (along, back) in enumerate(zip(differences, corner, strict=True))]
    )


def from_corner(gradient: Float[Tensor, "3 z y x"], corner: tuple[int, int, int]) -> Float[Tensor, "3 z y x"]:
    """The adjoint of `at_corner`, which is its inverse: each difference belongs to one voxel at each corner."""
    back_z, back_y, back_x = corner
    return at_corner(gradient, (-back_z, -back_y, -back_x))
