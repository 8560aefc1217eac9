"""How carefully to compute: the one place where accuracy is traded for time."""

import math
from dataclasses import dataclass
from numbers import Integral
from typing import Literal, Protocol, get_args

from torchdic.specimen.interpolation import Interpolation

Solver = Literal["euler", "midpoint", "rk4", "bosh3", "dopri5", "dopri8"]
Defocus = Literal["exact", "paraxial"]
AberrationMethod = Literal["linear", "cone"]
ADAPTIVE: frozenset[Solver] = frozenset({"bosh3", "dopri5", "dopri8"})


class Checked(Protocol):
    """What a fidelity needs of a propagation; see `torchdic.propagation.base.Propagation`."""

    def check(self, fidelity: "Fidelity") -> None:
        """Raise ValueError if the fidelity asks for something that the propagation can't do."""
        ...


# All propagations by name. `torchdic.propagation.base.register` adds one.
PROPAGATIONS: dict[str, Checked] = {}


@dataclass(frozen=True)
class Fidelity:
    """How carefully an image is computed. What the image shows is set by Microscope and Acquisition.

    propagation: how light crosses the specimen. "projection" follows straight rays, "rays" follows bent rays (the ray
        ODE), "wave" solves the one-way wave equation by split steps.
    steps: number of equal steps (rays) or slabs (wave) through the whole volume. None is one per slice. Fewer steps
        average slices, more steps subdivide them. Projection uses them only for object_aberration.
    sources: largest number of condenser directions, if the condenser names no points of its own. K rings of 2K
        directions serve best (8, 18, 32, 50, 72, 98, 128, 200). Other numbers may not light the specimen alike from
        opposite sides, and the bright field of a weak phase is sensitive to that.
    interpolation: of the index between voxel centres: "linear" or "cubic" (C² spline). The wave ignores it and uses
        the voxels as they are.
    solver: torchdiffeq's method for the ray ODE. The methods bosh3, dopri5 and dopri8 adapt their steps: they keep the
        error of every single ray within `tolerance` and ignore `steps`.
    tolerance: largest local error of an adaptive solver, both absolute in µm and relative.
    amplitude: whether rays carry an amplitude that conserves energy. False is for studying what the amplitude does.
    order: of the split step: 2 (4 FFTs per slab) or 1 (2 FFTs per slab).
    defocus: how light goes from the specimen to the plane of focus: "exact", by p_z − p_z0, or "paraxial", by −(|p|² −
        |p0|²)/(2n0), as in earlier models. Inside the specimen waves are exact in both cases.
    band_limit: whether waves that leave the array on their way to a focus are cut. This is right for a specimen that
        stands alone, and cheaper than the padding that would hold these waves. If False, they come back in at the
        opposite side, which is right for a periodic specimen. In both cases a WrapAroundWarning states their part of
        the light.
    object_aberration: method for the defocus that the specimen itself adds to each object point, by which the point
        then spreads (Kagalwala & Kanade, Eq. 6): "linear" around an axial ray, "cone" over the condenser's aperture,
        None leaves it out. The defocus is computed once per image, by rk4 in `steps` through a cubic spline. It stands
        in for the amplitude, which straight rays lack, and bent rays without `amplitude`. It makes up for about half of
        it.
    reference_plane: depth in µm at which rays are turned into a field. None is the slice centre or face nearest to the
        |Δn|-weighted mean depth.
    padding: voxels of background added on each side along y and x during the computation.
    memory: bytes that an image and its gradient may hold at once, without the volume (see `torchdic.foreseen`). Sources
        are computed in batches that stay within this budget, or within the free memory if that is less. The backward
        pass computes the batches again. If even a single source needs more, its steps are computed again too, slab by
        slab. That is the least possible: a smaller budget is exceeded.
    Raises ValueError if a value breaks its law.
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
        for name, least in (("steps", 1), ("sources", 1), ("padding", 0)):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, Integral) and int(value) >= least):
                raise ValueError(f"{name} {value} must be a whole number of at least {least}")
        if not 0 < self.tolerance < math.inf:
            raise ValueError(f"tolerance {self.tolerance} must be above 0, and finite")
        if self.reference_plane is not None and not math.isfinite(self.reference_plane):
            raise ValueError(f"reference_plane {self.reference_plane} must be a finite depth in µm")
        if not self.memory > 0:
            raise ValueError(f"memory {self.memory} must be above 0 bytes")
        PROPAGATIONS[self.propagation].check(self)
