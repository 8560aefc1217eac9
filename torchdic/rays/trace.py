"""Rays through a gradient of index: the ray ODE, solved by torchdiffeq.

With z as independent variable, p = n·(transverse direction) and p_z = √(n² − |p|²), Fermat's principle reads

    dx/dz = p/p_z,    dp/dz = n ∇⊥n / p_z.

This is the Hamiltonian form of Kagalwala & Kanade's Eq. 7; their printed Eq. 9 has misprints. Only differences are
integrated: the deviation from the unperturbed ray, which is straight in the background, and the difference W of the
optical path from that of the unperturbed plane wave. Rounding of the absolute values would lose the phase. With δp = p
− p0, δx = x − x_straight, B = n² − n0² and q = p_z − p_z0 = (B − δp·(p + p0))/(p_z + p_z0):

    dδx/dz = (δp − q p0/p_z0)/p_z,    dW/dz = (B + |δp|² + q²)/(2 p_z).

The transverse electric field E is carried parallel to itself along a ray of direction t: E' = −(E·t')t (Rytov's law).
The ray's local frame is (x, y, z) after the shortest turn from z to t. In this frame E turns by τ from +x towards +y,
because the direction sweeps the solid angle dτ = (1 − cosθ)dφ about z:

    dτ/dz = (p_x n_y − p_y n_x)/(p_z (n + p_z)).

This has no singularity on the axis, where the directions s and p are undefined.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import ADAPTIVE, Fidelity
from torchdic.grid import Grid
from torchdic.memory.batches import recompute
from torchdic.memory.batches import slabs as ranges
from torchdic.memory.held import crowded
from torchdic.memory.signature import is_learned
from torchdic.plane_waves import axial_momentum
from torchdic.rays.equation import MOVING, RayEquation
from torchdic.rays.solver import solve
from torchdic.specimen.interpolation import shares
from torchdic.specimen.volume import SampledVolume, Volume


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays that cross one plane of constant z.

    position: (…, 2), (y, x) in µm.
    momentum: (…, 2), n·(transverse direction), (y, x).
    opd: (…) in µm, the difference from each ray's own unperturbed plane wave.
    absorbed: (…), ∫κ ds in µm along the ray. None if nothing absorbs.
    turn: (…), τ in rad, the angle by which the electric field has turned from +x towards +y in the ray's local frame
        (see the module's docstring). None if it is not wanted.
    """

    position: Float[Tensor, "*ray 2"]
    momentum: Float[Tensor, "*ray 2"]
    opd: Float[Tensor, " *ray"]
    absorbed: Float[Tensor, " *ray"] | None = None
    turn: Float[Tensor, " *ray"] | None = None

    def like(self, other: Tensor) -> "Rays":
        """The rays with the dtype and device of a tensor; gradients are kept.

        Raises ValueError for vectors that aren't (y, x), and quantities of different numbers of rays.
        """
        held = {name: value for name, value in vars(self).items() if value is not None}
        shapes = {name: tuple(value.shape) for name, value in held.items()}
        for name in ("position", "momentum"):
            if shapes[name][-1:] != (2,):
                raise ValueError(f"{name} has shape {shapes[name]}, not (…, 2), (y, x)")
        try:
            torch.broadcast_shapes(
                *(shape[:-1] if n in ("position", "momentum") else shape for n, shape in shapes.items())
            )
        except RuntimeError as error:
            told = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise ValueError(f"{told} aren't of as many rays") from error
        return replace(self, **{name: value.to(other) for name, value in held.items()})


@dataclass(frozen=True, eq=False)
class Deviation:
    """How rays differ from their unperturbed selves on one plane.

    position: δx, (…, 2), (y, x) in µm.
    momentum: δp, (…, 2), (y, x).
    opd: W, (…) in µm.
    absorbed: ∫κ ds, (…) in µm. None if nothing absorbs.
    turn: τ, (…) in rad. None if it is not wanted.
    """

    position: Tensor
    momentum: Tensor
    opd: Tensor
    absorbed: Tensor | None
    turn: Tensor | None = None


def launch(
    grid: Grid, momentum: Float[Tensor, "source 2"], background: Tensor, plane: float = 0.0, margin: int = 0
) -> Rays:
    """A plane wave per source as rays on the volume's first face, position (source, y, x, 2).

    grid: of the volume.
    momentum: n·sinθ (y, x) of each source's direction, (source, 2).
    background: index of the medium, 0-d.
    plane: depth in µm at which the unperturbed rays cross the voxel centres.
    margin: further rows and columns of rays on each side.
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

    volume: the specimen.
    rays: on the first face.
    fidelity: its solver, tolerance, steps, interpolation and memory are used.
    Their `opd` grows by W, the difference from each ray's own unperturbed plane wave (with its momentum at the start,
    in the background). Their `turn`, if they have one, grows by τ. They have the dtype and device of the volume's Δn.
    Raises TurnedRaysError if a ray can't go on toward +z, because the index falls to its transverse momentum, and
    ValueError for shapes that don't fit together.
    """
    rays = rays.like(volume.delta)
    change = deviation(volume.sampled(fidelity.interpolation), rays, fidelity, turn=rays.turn is not None)
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
    volume: SampledVolume,
    rays: Rays,
    fidelity: Fidelity,
    *,
    start: float | None = None,
    turn: bool = False,
    watch: Callable[[Tensor], None] | None = None,
    slabs: bool | None = None,
) -> Deviation:
    """How rays deviate from their unperturbed selves at the volume's last face; see `trace`.

    volume: sampled.
    start: depth in µm of the plane on which the rays start. None is the first face.
    turn: whether to compute τ too.
    watch: called with (δy, δx, δp_y, δp_x), shape (4, …), without a graph. It is called after each equal step, or, by
        an adaptive solver, at the slices' faces.
    slabs: whether the backward pass computes the steps again, slab by slab. None does so if the steps would keep more
        than `fidelity.memory`.
    """
    position, momentum = torch.broadcast_tensors(rays.position, rays.momentum)
    flight = Flight(volume, position, momentum, fidelity, start=start, turn=turn, watch=watch)
    return flight.deviation(fly(flight, fidelity.memory, slabs))


class Flight:
    """Rays on their way from a plane in a volume to its last face, step by step, in the state of `RayEquation`.

    steps: number of equal steps, or of stretches that an adaptive solver crosses one by one.
    shape: of the rays.
    straight: the unperturbed rays, see `RayEquation`.
    """

    def __init__(
        self,
        volume: SampledVolume,
        position: Float[Tensor, "*ray 2"],
        momentum: Float[Tensor, "*ray 2"],
        fidelity: Fidelity,
        *,
        start: float | None = None,
        turn: bool = False,
        watch: Callable[[Tensor], None] | None = None,
    ) -> None:
        grid = volume.grid
        face = grid.extent[0] / 2
        self.volume, self.fidelity, self._turn = volume, fidelity, turn
        self.equal_steps = fidelity.solver not in ADAPTIVE
        self._start = -face if start is None else start
        self._watch, self._watched = watch, 0
        # y and x in separate rows: sums over pairs (y, x) would take most of the time otherwise
        place, p = position.movedim(-1, 0), momentum.movedim(-1, 0)
        pz = axial_momentum(volume.background, momentum)
        straight = torch.cat((place, p / pz, p, pz[None]))
        self.shape = straight.shape[1:]
        # divided among the CPU's threads until the end
        self.straight = straight.reshape(7, shares(grid, pz.numel(), straight.device), -1)
        whole = (fidelity.steps if self.equal_steps else None) or grid.shape[0]
        # a plane one rounding error above a step's end must not cost another step
        self.steps = math.ceil(whole * (face - self._start) / grid.extent[0] - 1e-9)
        # kept on the CPU: a depth read from another device would make every stage wait for it
        edges = torch.arange(self.steps + 1, dtype=straight.dtype)
        self._depths = self._start + (face - self._start) * edges / max(self.steps, 1)
        self._depths[-1] = face

    @property
    def learned(self) -> bool:
        """Whether there are several steps, and a gradient through them is wanted."""
        return self.steps > 1 and is_learned((self.straight, self.volume.background, self.volume.fields))

    def beginning(self) -> Float[Tensor, "component *ray"]:
        """The state of rays at their start: no deviation."""
        components = MOVING + len(self.volume.fields) + self._turn
        return self.straight.new_zeros(components, *self.straight.shape[1:])

    def cross(self, first: int, last: int, state: Float[Tensor, "component *ray"]) -> Float[Tensor, "component *ray"]:
        """The state after steps first … last − 1."""
        if self._watch is None or self.equal_steps:
            return self.advance(first, last, state)
        for step in range(first, last):
            state = self.advance(step, step + 1, state)
            self._show(step, state[:MOVING].detach())
        return state

    def advance(self, first: int, last: int, state: Float[Tensor, "component *ray"]) -> Float[Tensor, "component *ray"]:
        """Like `cross`, in one call of the solver."""
        equation, depths = self.equation(first, last)
        return solve(equation, state, depths, self.fidelity, lambda step, moving: self._show(first + step, moving))

    def equation(self, first: int, last: int) -> tuple[RayEquation, Float[Tensor, " depth"]]:
        """The equation of steps first … last − 1, with only the slices that they need, and the depths of their ends."""
        depths = self._depths[first : last + 1]
        # an adaptive solver looks beyond the end of its last step
        seen = depths if self.equal_steps else self._depths
        index, *absorption = self.volume.samplers((float(seen[0]), float(seen[-1])))
        kappa = absorption[0] if absorption else None
        return RayEquation(self.straight, self.volume.background, index, kappa, self._start, self._turn), depths

    def deviation(self, state: Float[Tensor, "component *ray"]) -> Deviation:
        """The deviation in a state at the last face. Raises TurnedRaysError if rays have stopped on their way."""
        state = state.reshape(len(state), *self.shape)
        stopped = ~torch.isfinite(state[MOVING])
        if bool(stopped.any()):
            raise TurnedRaysError.of(stopped)
        return Deviation(
            state[:2].movedim(0, -1),
            state[2:MOVING].movedim(0, -1),
            state[MOVING],
            state[MOVING + 1] if self.volume.absorbs else None,
            state[-1] if self._turn else None,
        )

    def _show(self, step: int, moving: Tensor) -> None:
        if self._watch is not None and step == self._watched:  # not when the step is computed again
            self._watch(moving.reshape(-1, *self.shape))
            self._watched += 1


def fly(flight: Flight, budget: int, slabs: bool | None = None) -> Float[Tensor, "component *ray"]:
    """The state of rays at the last face.

    budget: in bytes.
    slabs: whether the backward pass computes the steps again, slab by slab. None does so if the steps would keep more
        than the budget.
    """
    state = flight.beginning()
    if slabs is None:
        slabs = flight.learned and crowded(lambda: flight.cross(0, 1, state), flight.steps, budget)
    for first, last in ranges(flight.steps, split=slabs and flight.equal_steps):
        state = recompute(flight.cross, first, last, state, when=slabs)
    return state
