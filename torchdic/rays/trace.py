"""Rays through a gradient of index: the ray ODE, solved by torchdiffeq.

With z as independent variable and p = n·(transverse direction), p_z = √(n² − |p|²), Fermat's principle reads

    dx/dz = p/p_z,    dp/dz = n ∇⊥n / p_z

(the Hamiltonian form of Kagalwala & Kanade's Eq. 7; their printed Eq. 9 has misprints). Only the deviation from the
unperturbed ray, straight in the background, is integrated, and the optical path only as its difference W from the
unperturbed plane wave: the absolute ones would lose the phase to rounding. With δp = p − p0, δx = x − x_straight,
B = n² − n0² and q = p_z − p_z0 = (B − δp·(p + p0))/(p_z + p_z0):

    dδx/dz = (δp − q p0/p_z0)/p_z,    dW/dz = (B + |δp|² + q²)/(2 p_z).

The transverse electric field E is carried parallel to itself along a ray, E' = −(E·t')t for the direction t (Rytov's
law). Seen in the frame got from (x, y, z) by the shortest turn of z to t, it turns by τ from +x towards +y: directions
sweep the solid angle dτ = (1 − cosθ)dφ about z, which is

    dτ/dz = (p_x n_y − p_y n_x)/(p_z (n + p_z)),    without the singularity of s and p on the axis.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import ADAPTIVE, Fidelity
from torchdic.grid import Grid
from torchdic.memory.batches import recompute, slabs
from torchdic.plane_waves import axial_momentum
from torchdic.rays.equation import MOVING, RayEquation
from torchdic.rays.solver import TABLEAUX, solve
from torchdic.specimen.interpolation import SliceSampler, shares, window
from torchdic.specimen.volume import Volume


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays that cross one plane of constant z.

    position: (…, 2) in µm. momentum: (…, 2), n·(transverse direction). opd: (…) in µm, the difference from each ray's
    own unperturbed plane wave. absorbed: (…), ∫κ ds in µm along the ray, or None where nothing absorbs. turn: (…), τ
    in rad, how far the electric field has turned from +x towards +y in the frame local to the ray (the module's head),
    or None where no one asks.
    """

    position: Float[Tensor, "*ray 2"]
    momentum: Float[Tensor, "*ray 2"]
    opd: Float[Tensor, " *ray"]
    absorbed: Float[Tensor, " *ray"] | None = None
    turn: Float[Tensor, " *ray"] | None = None


@dataclass(frozen=True, eq=False)
class Deviation:
    """How rays differ from their unperturbed selves at one plane: δx, δp (…, 2), W (…), ∫κ ds and τ (…) or None."""

    position: Tensor
    momentum: Tensor
    opd: Tensor
    absorbed: Tensor | None
    turn: Tensor | None = None


def launch(
    grid: Grid, momentum: Float[Tensor, "source 2"], background: Tensor, plane: float = 0.0, margin: int = 0
) -> Rays:
    """A plane wave per source as rays on the volume's first face, position (source, y, x, 2).

    Unperturbed, they would cross `plane` (µm) at the voxel centres, continued by `margin` rows and columns a side.
    """
    wide = grid.widened(margin, margin)
    y, x = (wide.coordinates(axis, dtype=momentum.dtype, device=momentum.device) for axis in (1, 2))
    landing = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1)
    p0 = momentum[:, None, None, :]
    slope = p0 / axial_momentum(background, p0)[..., None]
    position = landing + slope * (-grid.extent[0] / 2 - plane)
    return Rays(position, p0.expand_as(position), position.new_zeros(position.shape[:-1]))


def trace(volume: Volume, rays: Rays, fidelity: Fidelity) -> Rays:
    """Rays from the volume's first face, z = −nz·dz/2, to its last, z = +nz·dz/2.

    Their `opd` grows by W, the difference from each ray's own unperturbed plane wave (its momentum at the start, in the
    background), and their `turn`, if they have one, by τ. Raises TurnedRaysError where a ray can't go on toward +z: the
    index falls to its transverse momentum.
    """
    change = deviation(volume, rays, fidelity, turn=rays.turn is not None)
    slope = rays.momentum / axial_momentum(volume.background, rays.momentum)[..., None]
    absorbed = change.absorbed
    if absorbed is not None and rays.absorbed is not None:
        absorbed = absorbed + rays.absorbed
    return Rays(
        rays.position + slope * volume.grid.extent[0] + change.position,
        rays.momentum + change.momentum,
        rays.opd + change.opd,
        absorbed,
        None if rays.turn is None or change.turn is None else rays.turn + change.turn,
    )


def deviation(
    volume: Volume,
    rays: Rays,
    fidelity: Fidelity,
    fields: Sequence[Float[Tensor, "z y x"]] | None = None,
    *,
    turn: bool = False,
    watch: Callable[[Tensor], None] | None = None,
) -> Deviation:
    """How rays that start at the volume's first face deviate from their unperturbed selves at its last; see `trace`.

    fields: `Volume.sampled`, where it serves several calls. turn: whether to find τ too. watch: is shown (δy, δx, δp_y,
    δp_x), shape (4, …) and without a graph, after each step or, by an adaptive solver, at the slices' faces.
    """
    grid, n0 = volume.grid, volume.background
    fields = fields or volume.sampled(fidelity.interpolation)
    slices = [f.unbind(0) for f in fields]
    face = -grid.extent[0] / 2
    # y and x apart: the solution is spent on sums over pairs otherwise
    position, momentum = (v.movedim(-1, 0) for v in torch.broadcast_tensors(rays.position, rays.momentum))
    pz0 = axial_momentum(n0, rays.momentum).expand(momentum.shape[1:])
    straight = torch.cat((position, momentum / pz0, momentum, pz0[None]))
    shape = straight.shape[1:]  # laid out for the CPU's threads until the end
    straight = straight.reshape(7, shares(grid, shape.numel(), straight.device), -1)

    watched = 0

    def show(step: int, moving: Tensor) -> None:
        nonlocal watched
        if watch is not None and step == watched:  # not when it is computed again
            watch(moving.reshape(-1, *shape))
            watched += 1

    def cross(first: int, last: int, state: Tensor) -> Tensor:
        if watch is None or equal_steps:
            return advance(first, last, state)
        for step in range(first, last):
            state = advance(step, step + 1, state)
            show(step, state[:MOVING].detach())
        return state

    def advance(first: int, last: int, state: Tensor) -> Tensor:
        times = depths[first : last + 1]
        # an adaptive solver looks beyond the end of its last step
        seen = times if equal_steps else depths
        near = window(grid, float(seen[0]), float(seen[-1]), fidelity.interpolation)
        index, *absorption = (SliceSampler(grid, s[near], fidelity.interpolation, near.start) for s in slices)
        kappa = absorption[0] if absorption else None
        equation = RayEquation(straight, n0, index, kappa, face, turn)
        return solve(equation, state, times, fidelity, lambda step, moving: show(first + step, moving))

    state = straight.new_zeros(4 + len(fields) + turn, *straight.shape[1:])
    equal_steps = fidelity.solver not in ADAPTIVE
    steps = steps_of(grid, fidelity)
    # kept on the CPU: a depth read from another device would make every stage wait for it
    depths = face + grid.extent[0] * torch.arange(steps + 1, dtype=state.dtype) / steps
    depths[-1] = -face
    kept = kept_by_rays(grid, fidelity, absorbs=volume.absorption is not None)
    crowded = kept * state[0].numel() * state.element_size() > fidelity.memory
    for first, last in slabs(steps, split=crowded and equal_steps):
        state = recompute(cross, first, last, state, when=crowded)
    state = state.reshape(len(state), *shape)
    stopped = ~torch.isfinite(state[4])
    if bool(stopped.any()):
        raise TurnedRaysError.of(stopped)
    position, momentum = state[:2].movedim(0, -1), state[2:4].movedim(0, -1)
    absorbed = None if volume.absorption is None else state[5]
    return Deviation(position, momentum, state[4], absorbed, state[-1] if turn else None)


def steps_of(grid: Grid, fidelity: Fidelity) -> int:
    """Equal steps through the volume, or the stretches after each of which an adaptive solver is looked at."""
    return (None if fidelity.solver in ADAPTIVE else fidelity.steps) or grid.shape[0]


def kept_by_rays(grid: Grid, fidelity: Fidelity, *, absorbs: bool = False) -> int:
    """Values per ray that the backward pass keeps: where each step began, and what its evaluations sampled."""
    # an adaptive solver keeps a state for each, and how many there are is known afterwards
    evaluations = len(TABLEAUX[fidelity.solver][1]) if fidelity.solver in TABLEAUX else 6
    return (4 + (3 + absorbs) * evaluations) * steps_of(grid, fidelity)
