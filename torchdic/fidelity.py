"""How carefully to compute: the one place where accuracy is traded for time."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from torchdic.sampling import Interpolation

Propagation = Literal["projection", "rays", "wave"]
Solver = Literal["euler", "midpoint", "rk4", "bosh3", "dopri5", "dopri8"]
ADAPTIVE: frozenset[Solver] = frozenset({"bosh3", "dopri5", "dopri8"})


@dataclass(frozen=True)
class Fidelity:
    """How an image is computed; what it shows is said by Microscope and Acquisition.

    propagation: how light crosses the specimen: "projection" along straight rays, "rays" along bent ones (the ray ODE),
        "wave" by the split-step solution of the one-way wave equation.
    steps: equal steps (rays) or slabs (wave) through the whole volume; None is one per slice. Fewer average slices,
        more subdivide them. Projection ignores it.
    sources: condenser directions at most, where the condenser names no points of its own.
    interpolation: between voxel centres, "linear" or "cubic" (C² spline); the wave reads voxels as they are.
    solver: torchdiffeq's method for rays. The adaptive ones (bosh3, dopri5, dopri8) hold every single ray to
        `tolerance` and ignore `steps`.
    tolerance: largest local error of an adaptive solver, absolute in µm and relative.
    amplitude: whether rays carry their energy's amplitude; False is for studying what it does.
    order: of the split step: 2 (4 FFTs a slab) or 1 (2 FFTs).
    reference_plane: depth in µm at which rays are turned into a field; None is the slice's centre or face nearest to
        the |Δn|-weighted mean depth.
    padding: voxels of the medium around the volume's sides on each side during the computation.
    memory: bytes that one batch of sources may keep for the backward pass; above it slabs and batches are recomputed.
    Raises ValueError where a value breaks its law.
    """

    propagation: Propagation = "wave"
    steps: int | None = None
    sources: int = 40
    interpolation: Interpolation = "linear"
    solver: Solver = "rk4"
    tolerance: float = 1e-6
    amplitude: bool = True
    order: Literal[1, 2] = 2
    reference_plane: float | None = None
    padding: int = 0
    memory: int = 1 << 30

    def __post_init__(self) -> None:
        for name, kind in (
            ("propagation", Propagation),
            ("interpolation", Interpolation),
            ("solver", Solver),
            ("order", Literal[1, 2]),
        ):
            value = getattr(self, name)
            if value not in get_args(kind):
                raise ValueError(f"{name} {value!r} must be one of {', '.join(map(repr, get_args(kind)))}")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps {self.steps} must be at least 1")
        if self.sources < 1:
            raise ValueError(f"sources {self.sources} must be at least 1")
        if self.padding < 0:
            raise ValueError(f"padding {self.padding} must be at least 0 voxels")
        if not 0 < self.tolerance < math.inf:
            raise ValueError(f"tolerance {self.tolerance} must be above 0, and finite")
        if self.reference_plane is not None and not math.isfinite(self.reference_plane):
            raise ValueError(f"reference_plane {self.reference_plane} must be a finite depth in µm")
        if not self.memory > 0:
            raise ValueError(f"memory {self.memory} must be above 0 bytes")


DRAFT = Fidelity("projection", sources=12)
STANDARD = Fidelity("wave")
REFERENCE = Fidelity("wave", sources=120, interpolation="cubic")
