"""How carefully to compute: the one place where accuracy is traded for time."""

import math
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

from torchdic.specimen.interpolation import Interpolation

Solver = Literal["euler", "midpoint", "rk4", "bosh3", "dopri5", "dopri8"]
Defocus = Literal["exact", "paraxial"]
AberrationMethod = Literal["linear", "cone"]
ADAPTIVE: frozenset[Solver] = frozenset({"bosh3", "dopri5", "dopri8"})


class Checked(Protocol):
    """What a fidelity asks of a propagation, see `torchdic.propagation.base.Propagation`."""

    def check(self, fidelity: "Fidelity") -> None:
        """Raise ValueError where the fidelity asks for what the propagation can't have."""
        ...


# Every propagation by its name. `torchdic.propagation.base.register` adds one; a fidelity names one of them.
PROPAGATIONS: dict[str, Checked] = {}


@dataclass(frozen=True)
class Fidelity:
    """How an image is computed; what it shows is said by Microscope and Acquisition.

    propagation: how light crosses the specimen: "projection" along straight rays, "rays" along bent ones (the ray ODE),
        "wave" by the split-step solution of the one-way wave equation.
    steps: equal steps (rays) or slabs (wave) through the whole volume; None is one per slice. Fewer average slices,
        more subdivide them. Projection ignores it, but for its object_aberration.
    sources: condenser directions at most, where the condenser names no points of its own. K rings of 2K serve best (8,
        18, 32, 50, 72, 98, 128, 200): other numbers may not light from opposite sides alike, to which the bright field
        of a weak phase is sensitive.
    interpolation: between voxel centres, "linear" or "cubic" (C² spline); the wave reads voxels as they are.
    solver: torchdiffeq's method for rays. The adaptive ones (bosh3, dopri5, dopri8) hold every single ray to
        `tolerance` and ignore `steps`.
    tolerance: largest local error of an adaptive solver, absolute in µm and relative.
    amplitude: whether rays carry their energy's amplitude; False is for studying what it does.
    order: of the split step: 2 (4 FFTs a slab) or 1 (2 FFTs).
    defocus: from where light leaves the specimen to the plane of focus: "exact", by p_z − p_z0, or "paraxial", by
        −(|p|² − |p0|²)/(2n0), as earlier models have it; inside the specimen waves are exact in either case.
    band_limit: whether waves that leave the array on their way to a focus are cut, as is right for a specimen that
        stands alone, and cheaper than the padding that holds them; otherwise they come back in at the opposite side, as
        is right for a periodic one. A WrapAroundWarning names their part of the light in either case.
    object_aberration: how the specimen's own defocus of each object point is found, with which it then spreads
        (Kagalwala & Kanade, Eq. 6): "linear" around an axial ray, "cone" over the condenser's aperture; None leaves it
        out. Found once an image, by rk4 in `steps` through a cubic spline. It stands in for the amplitude that straight
        rays lack, or bent ones without `amplitude`, and makes up for about half of it.
    reference_plane: depth in µm at which rays are turned into a field; None is the slice's centre or face nearest to
        the |Δn|-weighted mean depth.
    padding: voxels of the medium around the volume's sides on each side during the computation.
    memory: bytes that an image may hold at once, its gradient included, beside the volume (see `torchdic.foreseen`).
        Sources go in batches that stay within it, or within what is free if that is less, and batches are computed
        again in the backward pass; if a single source wants more, so are its steps, slab by slab. Less than that can't
        be had: a budget below it is exceeded.
    Raises ValueError where a value breaks its law.
    """

    propagation: str = "wave"
    steps: int | None = None
    sources: int = 40
    interpolation: Interpolation = "linear"
    solver: Solver = "rk4"
    tolerance: float = 1e-6
    amplitude: bool = True
    order: Literal[1, 2] = 2
    defocus: Defocus = "exact"
    band_limit: bool = False
    object_aberration: AberrationMethod | None = None
    reference_plane: float | None = None
    padding: int = 0
    memory: int = 1 << 30

    def __post_init__(self) -> None:
        if self.propagation not in PROPAGATIONS:
            raise ValueError(f"propagation {self.propagation!r} must be one of {', '.join(map(repr, PROPAGATIONS))}")
        for name, kind in (
            ("interpolation", Interpolation),
            ("solver", Solver),
            ("order", Literal[1, 2]),
            ("defocus", Defocus),
        ):
            value = getattr(self, name)
            if value not in get_args(kind):
                raise ValueError(f"{name} {value!r} must be one of {', '.join(map(repr, get_args(kind)))}")
        method = self.object_aberration
        if method is not None and method not in get_args(AberrationMethod):
            raise ValueError(f"object_aberration {method!r} must be one of 'linear', 'cone'")
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
        PROPAGATIONS[self.propagation].check(self)
