"""What is known of a specimen before it is seen: it is made of few pieces, and mostly medium."""

from jaxtyping import Float
from torch import Tensor

# Rounds off the corner of |∇Δn| where it is 0, far below any contrast that DIC sees.
SMOOTHING = 1e-5


def total_variation(delta: Float[Tensor, "z y x"], spacing: tuple[float, float, float]) -> Float[Tensor, ""]:
    """Mean length of the differences to the next voxel along z, y and x, all scaled to the spacing along x."""
    squares = delta.new_full(delta.shape, SMOOTHING**2)
    for axis, step in enumerate(spacing):
        if delta.shape[axis] > 1:
            difference = delta.diff(dim=axis, append=delta.narrow(axis, -1, 1)) * (spacing[2] / step)
            squares = squares + difference.square()
    return squares.sqrt().mean()


def magnitude(delta: Float[Tensor, "z y x"]) -> Float[Tensor, ""]:
    """Mean |Δn|. DIC does not see a uniform Δn: this fixes it at 0 where nothing else speaks."""
    return delta.abs().mean()
