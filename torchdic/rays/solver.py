"""The solution of the ray ODE by torchdiffeq. Its backward pass uses what each evaluation sampled.

For a method of equal steps the backward pass is the method's own adjoint. The stages are k_i = f(s_i), s_i = y + h Σ_j
a_ij k_j, and the step's end is y' = y + h Σ b_i k_i. From the last stage to the first

    k̄_i = h (b_i ȳ' + Σ_j>i a_ji s̄_j),    s̄_i = k̄_i ∂f/∂s_i,    ȳ = ȳ' + Σ s̄_i.

This is the exact derivative of what was computed. It reads the volume again only for the slope of what was sampled.
(torchdiffeq's odeint_adjoint solves another ODE backward, whose state would hold the volume.) For an adaptive method
autograd makes the backward pass, evaluation by evaluation.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count, pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.fidelity import ADAPTIVE, Fidelity, Solver
from torchdic.rays.equation import MOVING, Met, Pulled, RayEquation
from torchdic.specimen.interpolation import SliceSampler, depth_weights

# torchdiffeq's explicit Runge-Kutta methods of equal steps: the rows of a, then b. Its rk4 is the 3/8 rule.
TABLEAUX: dict[Solver, tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]] = {
    "euler": (((),), (1,)),
    "midpoint": (((), (1 / 2,)), (0, 1)),
    "rk4": (((), (1 / 3,), (-1 / 3, 1), (1, -1, 1)), (1 / 8, 3 / 8, 3 / 8, 1 / 8)),
}


def solve(
    equation: RayEquation,
    state: Float[Tensor, "component *ray"],
    depths: Float[Tensor, " depth"],
    fidelity: Fidelity,
    watch: Callable[[int, Tensor], None] = lambda *_: None,
) -> Float[Tensor, "component *ray"]:
    """The state at the last of some depths, from the state at the first.

    equation: of the rays.
    state: at the first depth, (component, …).
    depths: in µm, on the CPU: each stage would have to wait for a depth from another device. A method of equal steps
        takes one step from each depth to the next.
    fidelity: its solver and tolerance are used.
    watch: called after each equal step with the step's number, from 0, and the moving components, without a graph.
    A ray that can't go on toward +z ends as nan.
    """
    if fidelity.solver not in ADAPTIVE:
        keep = torch.is_grad_enabled() and any(t.requires_grad for t in (state, *equation.tensors))
        return _EqualSteps.apply(equation, depths, fidelity.solver, keep, watch, state, *equation.tensors)  # pyright: ignore[reportReturnType]

    # torchdiffeq's own norm is a mean over all rays, so a few hard rays may err among many easy ones. After an empty
    # stretch its steps grow so long that they would jump over a specimen or far beyond the volume. Its own choice of a
    # first step depends on the state, so that gradients would run through the depths
    slice_ = equation.index.grid.spacing[0]
    options = {"norm": _largest, "first_step": slice_, "max_step": slice_}
    tolerance, method = fidelity.tolerance, fidelity.solver
    try:
        return _odeint(
            lambda z, s: slopes(equation, z, s)[0],
            state,
            depths,
            rtol=tolerance,
            atol=tolerance,
            method=method,
            options=options,
        )
    except AssertionError:
        # torchdiffeq gives up where a ray turns; equal steps give nan there
        end = solve(equation, state, depths, replace(fidelity, solver="rk4"))
        if bool(torch.isfinite(end).all()):
            raise
        return end


def slopes(
    equation: RayEquation, z: float, state: Float[Tensor, "component *ray"]
) -> tuple[Float[Tensor, "component *ray"], Float[Tensor, "3 *ray"]]:
    """d(state)/dz at depth z in µm, and what the rays meet there: Δn and its derivatives along y and x in 1/µm.

    Both are differentiable in the state and in the equation's tensors.
    """
    return _Evaluation.apply(equation, z, state, *equation.tensors)  # pyright: ignore[reportReturnType]


def equal_steps(
    slopes: Callable[[float, Tensor], Tensor],
    state: Float[Tensor, "component *ray"],
    depths: Float[Tensor, " depth"],
    solver: Solver,
) -> Float[Tensor, "component *ray"]:
    """The state at the last of some depths (µm), by a method of `TABLEAUX` with a step from each depth to the next."""
    options = {"grid_constructor": lambda *_: depths}
    return _odeint(slopes, state, depths, method=solver, options=options)


class _EqualSteps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        equation: RayEquation,
        depths: Tensor,
        solver: Solver,
        keep: bool,
        watch: Callable[[int, Tensor], None],
        state: Tensor,
        *tensors: Tensor,
    ) -> Tensor:
        stages = len(TABLEAUX[solver][1])
        kept: list[Tensor] = []
        evaluations = count()

        def slopes(z: float, state: Tensor) -> Tensor:
            step, stage = divmod(next(evaluations), stages)
            if stage == 0 and step > 0:  # a step begins where the last one ended
                watch(step - 1, state[:MOVING])
            met = equation.meet(z, state[:MOVING])
            if keep:
                if stage == 0:
                    kept.append(met.moving.clone())  # a clone, so that the sums beside it are freed
                kept.extend([met.sampled] if met.kappa is None else [met.sampled, met.kappa])
            return equation.slopes(met)

        end = equal_steps(slopes, state, depths, solver)
        watch(len(depths) - 2, end[:MOVING])
        ctx.settings = _maker(equation), depths, solver
        ctx.save_for_backward(*tensors, *kept)
        return end

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, state_bar: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        make, depths, solver = ctx.settings
        saved = ctx.saved_tensors
        equation, kept = make(saved)
        del saved
        gradients = _Gradients(equation)
        a, b = TABLEAUX[solver]
        absorbs = equation.absorption is not None
        fields = 1 + absorbs
        moving_bar, sums_bar = state_bar[:MOVING], state_bar[MOVING:]
        for h, stages in reversed(_stages(solver, depths)):
            moving, *sampled = kept[-1 - fields * len(b) :]
            del kept[-1 - fields * len(b) :]
            # compute the step again from what it sampled
            mets: list[Met] = []
            slopes: list[Tensor] = []
            for i, row in enumerate(a):
                place = _advanced(moving, slopes, row, h)
                index, kappa = sampled[fields * i], sampled[fields * i + 1] if absorbs else None
                mets.append(equation.momenta(place, index, kappa))
                if i + 1 < len(b):
                    slopes.append(equation.moves(mets[i]))
            stage_bars: list[Tensor] = []  # of stages i + 1, i + 2, …, the last one first
            for i in reversed(range(len(b))):
                slopes_bar = moving_bar * (h * b[i])
                for j, stage_bar in zip(reversed(range(i + 1, len(b))), stage_bars, strict=True):
                    if a[j][i] != 0:
                        slopes_bar.add_(stage_bar, alpha=h * a[j][i])
                pulled = equation.pull_back(stages[i], mets.pop(), slopes_bar, sums_bar, h=h * b[i])
                gradients.add(stages[i], pulled)
                stage_bars.append(pulled.moving)
            moving_bar = moving_bar + stage_bars[0]
            for stage_bar in stage_bars[1:]:
                moving_bar.add_(stage_bar)
        return (*[None] * 5, torch.cat((moving_bar, sums_bar)), *gradients.bars)


class _Evaluation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, equation: RayEquation, z: float, state: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.settings = _maker(equation), z
        ctx.save_for_backward(state, *tensors)
        ctx.set_materialize_grads(False)
        met = equation.meet(z, state[:MOVING])
        return equation.slopes(met), met.sampled

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slopes_bar: Tensor | None, sampled_bar: Tensor | None) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        make, z = ctx.settings
        state, *tensors = ctx.saved_tensors
        equation, _ = make(tensors)
        gradients = _Gradients(equation)
        slopes_bar = torch.zeros_like(state) if slopes_bar is None else slopes_bar
        bars = slopes_bar[:MOVING].clone(), slopes_bar[MOVING:], sampled_bar
        pulled = equation.pull_back(z, equation.meet(z, state[:MOVING]), *bars)
        gradients.add(z, pulled)
        return (None, None, torch.cat((pulled.moving, torch.zeros_like(state[MOVING:]))), *gradients.bars)


class _Gradients:
    """The loss's derivatives by an equation's tensors, summed over its evaluations; None for a tensor not learned."""

    def __init__(self, equation: RayEquation) -> None:
        self.bars = [torch.zeros_like(t) if t.requires_grad else None for t in equation.tensors]
        self._sampler = equation.index

    def add(self, z: float, pulled: Pulled) -> None:
        for bar, term in zip(self.bars, (pulled.straight, pulled.background), strict=False):
            if bar is not None and term is not None:
                bar.add_(term)
        sampler = self._sampler
        for which, plane in enumerate(pulled.planes):
            if plane is None:
                continue
            for i, weight in depth_weights(sampler.grid, z, sampler.interpolation).items():
                bar = self.bars[2 + which * len(sampler.slices) + i - sampler.first]
                if bar is not None:
                    bar.add_(plane, alpha=weight)


def _stages(solver: Solver, depths: Tensor) -> list[tuple[float, list[float]]]:
    """Each step's length, and the depths of its evaluations."""
    nodes = [sum(row) for row in TABLEAUX[solver][0]]
    # take the end itself: rounding could give a depth beyond it, and a slab has only its own slices
    return [
        (last - first, [last if c == 1 else first + c * (last - first) for c in nodes])
        for first, last in pairwise(depths.tolist())
    ]


def _advanced(moving: Tensor, slopes: Sequence[Tensor], row: Sequence[float], h: float) -> Tensor:
    """Moving + h Σ row_j slopes_j."""
    if not any(row):
        return moving
    (first, slope), *others = [(h * c, k) for c, k in zip(row, slopes, strict=True) if c != 0]
    moved = torch.add(moving, slope, alpha=first)
    for c, slope in others:
        moved.add_(slope, alpha=c)
    return moved


def _maker(equation: RayEquation) -> Callable[[Sequence[Tensor]], tuple[RayEquation, list[Tensor]]]:
    """A function that makes the equation again from its tensors, as autograd returns them.

    It also returns the tensors that follow those of the equation. It holds no tensor itself. Otherwise the tensors of a
    solution that is computed again would be held until then.
    """
    index, face, turn = equation.index, equation.face, equation.turn
    grid, interpolation, first = index.grid, index.interpolation, index.first
    fields = 1 + (equation.absorption is not None)
    own = len(index.slices)

    def make(tensors: Sequence[Tensor]) -> tuple[RayEquation, list[Tensor]]:
        straight, background, *others = tensors
        samplers = [
            SliceSampler(grid, others[field * own : (field + 1) * own], interpolation, first) for field in range(fields)
        ]
        absorption = samplers[1] if fields > 1 else None
        return RayEquation(straight, background, samplers[0], absorption, face, turn), others[fields * own :]

    return make


def _odeint(slopes: Callable[[float, Tensor], Tensor], state: Tensor, depths: Tensor, **options: Any) -> Tensor:
    """Torchdiffeq's solution at the last of some depths."""
    from torchdiffeq import odeint  # loaded only where rays are traced

    ends = depths[[0, -1]].to(state.device)  # odeint needs its times on the state's device
    return torch.as_tensor(odeint(lambda z, s: slopes(float(z), s), state, ends, **options)[-1])


def _largest(state: Tensor) -> Tensor:
    return state.abs().max()
