"""What past steps tell of the misfit's curvature, on top of a weak specimen's: the BFGS update of a Hessian.

Each step s changed the misfit's gradient by y. The update makes the Hessian B agree, B·s = y, and changes it by two
vectors: B ← B − Bs(Bs)ᵀ/(sᵀBs) + yyᵀ/(sᵀy) (J. Nocedal and S. Wright, Numerical Optimization, 6.1). Where the misfit
bends the wrong way along a step, y is drawn towards Bs (M. J. D. Powell's damping, ibid. 18.3), so that B stays
positive.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

# Steps that are remembered.
MEMORY = 5

# Least curvature along a step, as a share of B's own, that is believed.
LEAST = 0.2

# A step and what it changed the gradient by, times the number of voxels.
Pair = tuple[Tensor, Tensor]

Operator = Callable[[Float[Tensor, "z y x"]], Float[Tensor, "z y x"]]


class Secants:
    """The update of a Hessian by pairs, W·diag(±1)·Wᵀ.

    hessian: to be updated. pairs: the oldest first.
    """

    def __init__(self, hessian: Operator, pairs: Sequence[Pair]) -> None:
        self._vectors: list[Tensor] = []
        self._signs: list[float] = []
        for step, change in pairs:
            expected = hessian(step) + self(step)
            own, seen = float((step * expected).sum()), float((step * change).sum())
            if not own > 0:
                continue
            share = 1.0 if seen >= LEAST * own else (1 - LEAST) * own / (own - seen)
            believed = share * change + (1 - share) * expected
            curved = float((step * believed).sum())
            self._vectors += [believed / curved**0.5, expected / own**0.5]
            self._signs += [1.0, -1.0]

    def __call__(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """The update times a volume."""
        total = torch.zeros_like(delta)
        for vector, sign in zip(self._vectors, self._signs, strict=True):
            total.add_(vector, alpha=sign * float((vector * delta).sum()))
        return total

    def solved(self, solve: Operator) -> Operator:
        """The inverse of a matrix plus this update, given the matrix's (the formula of Woodbury)."""
        if not self._vectors:
            return solve
        solutions = [solve(vector) for vector in self._vectors]
        products = torch.tensor([[float((v * s).sum()) for s in solutions] for v in self._vectors], dtype=torch.float64)
        small = torch.linalg.inv(torch.diag(torch.tensor(self._signs, dtype=torch.float64)) + products)

        def solve_updated(right: Tensor) -> Tensor:
            found = solve(right)
            along = torch.tensor([float((vector * found).sum()) for vector in self._vectors], dtype=torch.float64)
            for weight, solution in zip((small @ along).tolist(), solutions, strict=True):
                found = found.sub(solution, alpha=weight)
            return found

        return solve_updated
