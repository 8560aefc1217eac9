"""The ray ODE's solution by torchdiffeq, with a backward pass that keeps each evaluation's state and nothing else.

Behind a method of equal steps the backward pass is the method's own adjoint: with stages k_i = f(s_i),
s_i = y + h Σ_j a_ij k_j and y' = y + h Σ b_i k_i, from the last to the first

    k̄_i = h (b_i ȳ' + Σ_j>i a_ji s̄_j),    s̄_i = k̄_i ∂f/∂s_i,    ȳ = ȳ' + Σ s̄_i,

the exact derivative of what was computed. (torchdiffeq's odeint_adjoint solves another ODE backward, whose state would
hold the volume.) An adaptive method's backward pass is autograd's, evaluation by evaluation.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torchdiffeq import odeint

from torchdic.fidelity import ADAPTIVE, Fidelity, Solver
from torchdic.ray_equation import Pulled, RayEquation
from torchdic.sampling import SliceSampler, depth_weights

# torchdiffeq's methods of equal steps, explicit Runge-Kutta (a, b) row by row; its rk4 is the 3/8 rule.
TABLEAUX: dict[Solver, tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]] = {
    "euler": (((),), (1,)),
    "midpoint": (((), (1 / 2,)), (0, 1)),
    "rk4": (((), (1 / 3,), (-1 / 3, 1), (1, -1, 1)), (1 / 8, 3 / 8, 3 / 8, 1 / 8)),
}


def solve(
    equation: RayEquation, state: Float[Tensor, "component *ray"], depths: Float[Tensor, " depth"], fidelity: Fidelity
) -> Float[Tensor, "component *ray"]:
    """The state at the last of some depths in µm, from the one at the first.

    A method of equal steps takes one from each depth to the next. Depths belong on the CPU: one read from another
    device would make every stage wait for it. Of `fidelity` solver and tolerance are read. A ray that can't go on
    toward +z ends as nan.
    """
    if fidelity.solver not in ADAPTIVE:
        return _EqualSteps.apply(equation, depths, fidelity.solver, state, *equation.tensors)  # pyright: ignore[reportReturnType]

    def slopes(z: Tensor, state: Tensor) -> Tensor:
        return _Evaluation.apply(equation, float(z), state, *equation.tensors)  # pyright: ignore[reportReturnType]

    # torchdiffeq's own norm is a mean over all rays, which lets a few hard ones err among many easy ones; and after an
    # empty stretch its steps grow so long that they would jump over a specimen or far beyond the volume. Its own choice
    # of a first step depends on the state, and gradients would run through the depths
    slice_ = equation.index.grid.spacing[0]
    options = {"norm": _largest, "first_step": slice_, "max_step": slice_}
    tolerance, method = fidelity.tolerance, fidelity.solver
    try:
        path = odeint(
            slopes, state, _ends(depths, state), rtol=tolerance, atol=tolerance, method=method, options=options
        )
        return torch.as_tensor(path[-1])
    except AssertionError:
        # it gives up where a ray turns; equal steps leave nan there
        end = solve(equation, state, depths, replace(fidelity, solver="rk4"))
        if bool(torch.isfinite(end).all()):
            raise
        return end


class _EqualSteps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, equation: RayEquation, depths: Tensor, solver: Solver, state: Tensor, *tensors: Tensor
    ) -> Tensor:
        visited: list[float] = []
        states: list[Tensor] = []
        keep = any(ctx.needs_input_grad)

        def slopes(z: Tensor, state: Tensor) -> Tensor:
            if keep:
                visited.append(float(z))
                states.append(state)
            return equation.slopes(float(z), state)

        options = {"grid_constructor": lambda *_: depths}
        path = odeint(slopes, state, _ends(depths, state), method=solver, options=options)
        ctx.settings = equation, visited, depths, solver
        ctx.save_for_backward(*tensors, *states)
        return torch.as_tensor(path[-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, state_bar: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        equation, visited, depths, solver = ctx.settings
        saved = ctx.saved_tensors
        tensors, states = saved[: -len(visited)], saved[-len(visited) :]
        equation = _of(equation, tensors)
        sums = _Sums(equation)
        a, b = TABLEAUX[solver]
        stages = len(b)
        for step, h in reversed(list(enumerate(depths.diff().tolist()))):
            stage_bars: list[Tensor] = []  # of stages i + 1 …, the last one first
            for i in reversed(range(stages)):
                k_bar = state_bar * (h * b[i])
                for j, stage_bar in zip(reversed(range(i + 1, stages)), stage_bars, strict=True):
                    if a[j][i] != 0:
                        k_bar.add_(stage_bar, alpha=h * a[j][i])
                z, state = visited[stages * step + i], states[stages * step + i]
                pulled = equation.pull_back(z, state, k_bar)
                sums.add(z, pulled)
                stage_bars.append(pulled.state)
            state_bar = sum(stage_bars, state_bar)
        return (None, None, None, state_bar, *sums.bars)


class _Evaluation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, equation: RayEquation, z: float, state: Tensor, *tensors: Tensor) -> Tensor:
        ctx.settings = equation, z
        ctx.save_for_backward(state, *tensors)
        return equation.slopes(z, state)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slopes_bar: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        equation, z = ctx.settings
        state, *tensors = ctx.saved_tensors
        equation = _of(equation, tensors)
        sums = _Sums(equation)
        pulled = equation.pull_back(z, state, slopes_bar)
        sums.add(z, pulled)
        return (None, None, pulled.state, *sums.bars)


class _Sums:
    """The loss's derivatives in an equation's tensors, summed over its evaluations."""

    def __init__(self, equation: RayEquation) -> None:
        self.bars = [torch.zeros_like(t) for t in equation.tensors]
        self._sampler = equation.index

    def add(self, z: float, pulled: Pulled) -> None:
        self.bars[0].add_(pulled.straight)
        self.bars[1].add_(pulled.background)
        sampler = self._sampler
        for which, plane in enumerate(pulled.planes):
            for i, weight in depth_weights(sampler.grid, z, sampler.interpolation).items():
                self.bars[2 + which * len(sampler.slices) + i - sampler.first].add_(plane, alpha=weight)


def _of(equation: RayEquation, tensors: Sequence[Tensor]) -> RayEquation:
    """The equation on its tensors as autograd hands them back."""
    straight, background, *slices = (t.detach() for t in tensors)
    index = equation.index
    count = len(index.slices)
    samplers = [
        SliceSampler(index.grid, part, index.interpolation, index.first) if part else None
        for part in (slices[:count], slices[count:])
    ]
    return replace(equation, straight=straight, background=background, index=samplers[0], absorption=samplers[1])


def _ends(depths: Tensor, state: Tensor) -> Tensor:
    """What odeint asks for: it takes times that are not on the state's device."""
    return depths[[0, -1]].to(state.device)


def _largest(state: Tensor) -> Tensor:
    return state.abs().max()
