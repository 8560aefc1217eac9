"""The hand-written derivatives are those of what was computed: against autograd through torchdiffeq, to rounding."""

import dataclasses
from unittest import mock

import pytest
import torch
from torchdiffeq import odeint

from torchdic import Fidelity, Grid
from torchdic.memory.batches import recompute
from torchdic.rays.equation import RayEquation
from torchdic.rays.solver import TABLEAUX, solve
from torchdic.specimen.interpolation import SliceSampler, spline_coefficients

GRID = Grid((5, 7, 6), (0.5, 0.3, 0.4))


def problem(interpolation="linear", absorbing=False, turn=False, seed=0):
    """Rays in all directions through a rough volume, with everything that can be learned requiring grad."""
    torch.manual_seed(seed)
    fields = [0.05 * torch.randn(GRID.shape, dtype=torch.float64) for _ in range(1 + absorbing)]
    if interpolation == "cubic":
        fields = [spline_coefficients(f) for f in fields]
    fields = [f.requires_grad_() for f in fields]
    background = torch.tensor(1.4, dtype=torch.float64, requires_grad=True)
    momentum = 0.6 * torch.rand(2, 11, dtype=torch.float64) - 0.3
    position = 2 * torch.rand(2, 11, dtype=torch.float64) - 1
    pz = (background**2 - momentum.square().sum(0)).sqrt()
    straight = torch.cat((position, momentum / pz, momentum, pz[None])).detach().requires_grad_()
    index, *absorption = (SliceSampler(GRID, f.unbind(0), interpolation) for f in fields)
    equation = RayEquation(straight, background, index, absorption[0] if absorbing else None, -1.25, turn)
    return equation, [straight, background, *fields]


def at_first_face(equation):
    """The state on the first face."""
    components = 5 + (equation.absorption is not None) + equation.turn
    return equation.straight.new_zeros(components, *equation.straight.shape[1:])


def plain_slopes(equation, z, state):
    """The equation of torchdic.rays' docstring, for autograd."""
    y0, x0, vy, vx, py0, px0, pz0 = equation.straight
    n0, (dy, dx, dpy, dpx) = equation.background, state[:4]
    y, x = y0 + vy * (z - equation.face) + dy, x0 + vx * (z - equation.face) + dx
    delta, gy, gx = equation.index.sample(z, y, x)
    n, py, px = n0 + delta, py0 + dpy, px0 + dpx
    pz = (n * n - py * py - px * px).sqrt()
    contrast = n * n - n0 * n0
    q = pz - pz0
    change = [(dpy - vy * q) / pz, (dpx - vx * q) / pz, n * gy / pz, n * gx / pz]
    change.append((contrast + dpy**2 + dpx**2 + q**2) / (2 * pz))
    if equation.absorption is not None:
        change.append(n / pz * equation.absorption.value(z, y, x))
    if equation.turn:
        change.append((px * gy - py * gx) / (pz * (n + pz)))
    return torch.stack(change)


CASES = [
    {},
    {"interpolation": "cubic"},
    {"absorbing": True},
    {"turn": True},
    {"interpolation": "cubic", "absorbing": True, "turn": True},
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_slopes_are_those_of_the_equation(case):
    equation, _ = problem(**case)
    state = 0.01 * torch.randn_like(at_first_face(equation))
    with torch.no_grad():
        slopes = equation.slopes(equation.meet(0.3, state[:4]))
        torch.testing.assert_close(slopes, plain_slopes(equation, 0.3, state), rtol=0, atol=1e-14)


@pytest.mark.parametrize("solver", [*TABLEAUX, "dopri5"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_gradient_in_everything_is_autograds_through_torchdiffeq(case, solver):
    """The tableau's adjoint, not an approximation: a wrong coefficient or order of stages shows at once."""
    equation, learned = problem(**case)
    depths = torch.tensor([-1.25, -0.7, 0.2, 1.0], dtype=torch.float64)
    start = (0.01 * torch.randn_like(at_first_face(equation))).requires_grad_()
    weights = torch.randn_like(start)
    fidelity = Fidelity("rays", solver=solver, tolerance=1e-3, interpolation=equation.index.interpolation)
    end = solve(equation, start, depths, fidelity)
    if solver in TABLEAUX:
        options = {"grid_constructor": lambda *_: depths}
        ends = {"method": solver, "options": options}
    else:
        slice_ = GRID.spacing[0]
        norm = {"norm": lambda v: v.abs().max(), "first_step": slice_, "max_step": slice_}
        ends = {"method": solver, "rtol": 1e-3, "atol": 1e-3, "options": norm}
    plain = odeint(lambda z, s: plain_slopes(equation, float(z), s), start, depths[[0, -1]], **ends)[-1]
    torch.testing.assert_close(end, plain, rtol=0, atol=1e-13)
    found, expected = (torch.autograd.grad((v * weights).sum(), [start, *learned]) for v in (end, plain))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


def test_backward_pass_keeps_where_a_step_began_and_what_it_sampled_and_nothing_else():
    equation, _ = problem(absorbing=True, turn=True)
    depths = torch.linspace(-1.25, 1.25, 9, dtype=torch.float64)
    kept = {}

    def keep(tensor):
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        solve(equation, at_first_face(equation), depths, Fidelity("rays"))
    own = {t.untyped_storage().data_ptr() for t in equation.tensors}
    value = at_first_face(equation)[0].nbytes
    # δy, δx and their momenta; of 4 stages Δn with its gradient, and κ
    assert sum(size for pointer, size in kept.items() if pointer not in own) == 8 * (4 + 4 * 4) * value


def test_nothing_is_kept_where_nothing_is_learned():
    equation, _ = problem()
    index = SliceSampler(GRID, [s.detach() for s in equation.index.slices], "linear")
    straight, background = equation.straight.detach(), equation.background.detach()
    equation = dataclasses.replace(equation, straight=straight, background=background, index=index)
    depths = torch.linspace(-1.25, 1.25, 9, dtype=torch.float64)
    assert solve(equation, at_first_face(equation), depths, Fidelity("rays")).grad_fn is None


def test_nothing_is_kept_without_gradients():
    """Parameters require grad there too."""
    equation, _ = problem()
    depths = torch.linspace(-1.25, 1.25, 9, dtype=torch.float64)
    sizes = []
    with (
        torch.no_grad(),
        mock.patch.object(torch.autograd.function.FunctionCtx, "save_for_backward", lambda _, *t: sizes.append(len(t))),
    ):
        assert solve(equation, at_first_face(equation), depths, Fidelity("rays")).grad_fn is None
    assert sizes == [len(equation.tensors)]


def test_volume_changed_between_the_passes_is_an_error_not_a_wrong_gradient():
    equation, (_, _, field) = problem()
    end = solve(equation, at_first_face(equation), torch.tensor([-1.25, 1.25], dtype=torch.float64), Fidelity("rays"))
    with torch.no_grad():
        field.add_(1)
    with pytest.raises(RuntimeError, match="modified inplace"):
        end.sum().backward()


def test_recomputed_gradient_is_the_kept_one():
    equation, learned = problem(absorbing=True, turn=True)
    depths = torch.linspace(-1.25, 1.25, 5, dtype=torch.float64)
    kept, again = (
        torch.autograd.grad(
            recompute(solve, equation, at_first_face(equation), depths, Fidelity("rays"), when=when).sum(), learned
        )
        for when in (False, True)
    )
    for one, other in zip(kept, again, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
