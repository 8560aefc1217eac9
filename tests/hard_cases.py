"""Hard cases, each a small scene with the laws that it is held to: see test_stability.py and docs/stability.md."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import torch
from torch import Tensor

from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    SamplingWarning,
    Volume,
    image,
)
from torchdic.errors import SidewaysError, TurnedRaysError, UnstableError, WrapAroundWarning

T = TypeVar("T")
WAVELENGTH, N0 = 0.546, 1.36
GRID = Grid((8, 16, 18), (0.4, 0.2, 0.21))
SOURCES = ((0.0, 0.0), (0.3, -0.1), (-0.15, 0.35))
NA, NA_C = 0.75, 0.4


@dataclass(frozen=True, eq=False)
class Scene:
    """A specimen in a microscope: everything that may be learned in `values`, by name, in float64.

    values: delta, and in place of the defaults shear, bias, focus, absorption, "aberration 4", "retardance 6", …
    options: of Fidelity; `by_propagation` adds those of one propagation.
    """

    delta: Tensor
    grid: Grid = GRID
    values: Mapping[str, Tensor] = field(default_factory=dict)
    sources: tuple[tuple[float, float], ...] = SOURCES
    na: float | None = NA
    na_c: float = NA_C
    wavelength: float = WAVELENGTH
    options: Mapping[str, object] = field(default_factory=dict)
    by_propagation: Mapping[str, Mapping[str, object]] = field(default_factory=dict)

    def start(self) -> dict[str, Tensor]:
        """All that is learned, in float64."""
        usual = {"shear": (0.1, 0.2), "bias": 1.1, "focus": 0.6}
        usual = {name: torch.tensor(value, dtype=torch.float64) for name, value in usual.items()}
        return {"delta": self.delta, **usual, **self.values}

    def images(self, propagation: str, values: Mapping[str, Tensor]) -> Tensor:
        """Of one prism and of the bright field: (2, 1, y, x)."""
        aberrations, *pupil = (
            {int(name.split()[1]): v for name, v in values.items() if name.startswith(kind)} or None
            for kind in ("aberration", "retardance", "diattenuation")
        )
        pupil = [pairs and {noll: tuple(pair) for noll, pair in pairs.items()} for pairs in pupil]
        points = torch.tensor(self.sources, dtype=torch.float64)
        microscope = Microscope(
            self.wavelength,
            None if self.na is None else Objective(self.na, aberrations),
            Condenser(self.na_c, points),
            polarisation=Polarisation(pupil=JonesPupil(*pupil)) if any(pupil) else None,
        )
        acquisition = Acquisition([Prism(values["shear"], values["bias"]), None], [values["focus"]])
        volume = Volume(self.grid, values["delta"], N0, values.get("absorption"))
        return image(volume, microscope, acquisition, self.fidelity(propagation))

    def fidelity(self, propagation: str) -> Fidelity:
        return Fidelity(propagation, **{**self.options, **self.by_propagation.get(propagation, {})})


PROPAGATIONS = ("projection", "rays", "wave")
# Straight rays change phases alone; bent ones conserve energy to second order of their mesh, slabs to that of the phase
# that each adds, and as p_z·|S|², of which oblique light has less.
BRIGHT = {"projection": 1.0, "rays": 1.01, "wave": 1.01}
# Of Δn in central differences: a ray is smooth only piece by piece, between voxel centres and in the mesh's triangles.
STEP = {"projection": 1e-5, "rays": 1e-7, "wave": 1e-5}


@dataclass(frozen=True, eq=False)
class Case:
    """A scene and its laws; each is one for all propagations, or one by propagation.

    bright: what the mean of the bright field may not exceed, where no light can be made; BRIGHT else. exact: the images
    and the error allowed in float64, where they are known. rounding: float32's error of the images in its eps.
    difference: relative error of the gradient against central differences. step: of Δn in these; STEP else. beside: the
    size of a smooth field that Δn is changed by before its gradient is held to a law, where the case itself is a kink,
    with another gradient on every side. alone: propagations that refuse every neighbour of this Δn: its gradient need
    be finite only, and those of the scalars obey the law. gradient_rounding: float32's error of the gradient in eps,
    relative to its norm. cancels: scalars whose gradient is a small rest of its pixels' terms, so that its error is
    relative to the sum of these terms' sizes instead. refused: the error and what its line says. warned: likewise.
    sample: whether its rays and its gradients belong to the sample that `make test` runs, as the images of straight
    rays and waves do. slow: whether none of it does.
    """

    name: str
    scene: Callable[[], Scene]
    bright: float | Mapping[str, float] = field(default_factory=dict)
    exact: Callable[[Scene], Tensor] | None = None
    tolerance: float = 1e-14
    rounding: float | Mapping[str, float] = field(default_factory=dict)
    difference: float | Mapping[str, float] = field(default_factory=dict)
    step: float | Mapping[str, float] = field(default_factory=dict)
    beside: Mapping[str, float] = field(default_factory=dict)
    alone: tuple[str, ...] = ()
    gradient_rounding: float | Mapping[str, float] = field(default_factory=dict)
    cancels: tuple[str, ...] = ()
    refused: Mapping[str, tuple[type[Exception], str]] = field(default_factory=dict)
    warned: Mapping[str, tuple[type[Warning], str]] = field(default_factory=dict)
    sample: bool = False
    slow: bool = False

    def law(self, name: str, propagation: str) -> float:
        usual = {"bright": BRIGHT[propagation], "step": STEP[propagation], "difference": 1e-5}
        usual |= {"rounding": 128, "gradient_rounding": 2048}
        value = getattr(self, name)
        return value.get(propagation, usual[name]) if isinstance(value, Mapping) else value


def everywhere(law: T) -> dict[str, T]:
    return dict.fromkeys(PROPAGATIONS, law)


def places(grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    return torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in range(3)), indexing="ij")


def zeros(grid: Grid = GRID) -> Tensor:
    return torch.zeros(grid.shape, dtype=torch.float64)


def ball(contrast: float, sigma: float, grid: Grid = GRID, centre=(0.1, 0.15, -0.2)) -> Tensor:
    z, y, x = (v - c for v, c in zip(places(grid), centre, strict=True))
    return contrast * torch.exp(-(z**2 + y**2 + x**2) / (2 * sigma**2))


def smooth(contrast: float, grid: Grid = GRID) -> Tensor:
    """Periodic across the sides, alike in no two axes, and nowhere of gradient 0 for long."""
    z, y, x = (2 * math.pi * v / e for v, e in zip(places(grid), grid.extent, strict=True))
    return contrast * (torch.cos(y + 0.4 + 0.3 * z) + 0.7 * torch.sin(x - 2 * y + z) + 0.4 * torch.cos(2 * x + 1))


def hot_voxel() -> Tensor:
    delta = zeros()
    delta[4, 7, 9] = 0.3
    return delta


def half_space(contrast: float, grid: Grid = GRID) -> Tensor:
    delta = zeros(grid)
    delta[:, :, grid.shape[2] // 2 :] = contrast
    return delta


def checkerboard() -> Tensor:
    return 0.05 * (1 - 2 * (sum(torch.meshgrid(*map(torch.arange, GRID.shape), indexing="ij")) % 2)).double()


def ramp(contrast: float, grid: Grid) -> Tensor:
    """Rising all along x: its light is bent until the medium behind it can't take it."""
    return contrast * (1 + torch.tanh(places(grid)[2]))


def wedge(grid: Grid) -> Tensor:
    """As many waves across the array as its thickness and Δn from 0 to 0.1 make."""
    return (0.1 * (places(grid)[2] / grid.extent[2] + 0.5)).contiguous()


def dip(contrast: float, grid: Grid = GRID) -> Tensor:
    """A layer across the axis."""
    z, _, _ = places(grid)
    return contrast * torch.exp(-(z**2) / 0.5)


def empty_image(scene: Scene) -> Tensor:
    """Sin²(bias/2), and 1 in the bright field."""
    bias = scene.start()["bias"]
    both = torch.stack((torch.sin(bias / 2) ** 2, torch.ones((), dtype=torch.float64)))
    inside = sum(math.hypot(*p) <= (scene.na or math.inf) for p in scene.sources) / len(scene.sources)
    return (inside * both)[:, None, None, None].expand(2, 1, *scene.grid.shape[1:])


def value(**names: float | tuple[float, ...]) -> dict[str, Tensor]:
    return {name.replace("_", " "): torch.tensor(v, dtype=torch.float64) for name, v in names.items()}


def periodic_smooth_behind_medium(grid: Grid) -> Tensor:
    delta = smooth(1e-4, grid)
    delta[:-1] = 0
    return delta


# Undisturbed rays land just on pixels, the corners of the mesh's triangles, and so change from one triangle to the next
# with any step.
KINKS = {"beside": {"rays": 1e-3}, "step": {"rays": 1e-9}}
FEW_KINKS = {"rays": 1e-3}
GRAZING = ((0.0, 1.3), (-1.1, 0.6), (0.9, -0.9))
LIMIT = ((0.0, N0 - 1e-6), (0.0, 0.0))
TURN = TurnedRaysError, r"\d+ of \d+ rays can't go on toward \+z: inside the volume the index falls"
SIDE = (
    SidewaysError,
    r"rays leave sideways: .* displaced by up to \d+ voxels, more than 2 times the \d+ that are traced",
)
TRAPPED = TurnedRaysError, r"\d+ of \d+ rays can't go on toward \+z: in the medium behind the volume the index falls"
EVANESCENT = UnstableError, r"light of n·sinθ 1 can't go on toward \+z: inside the volume the index falls to 0.8\d+"
THICK = UnstableError, r"slabs of .* µm are too thick for Δn .*; use more than \d+ steps"
WRAPS = (
    WrapAroundWarning,
    r"focus 500 µm lies .* µm from the specimen: .* % of the light .*; \d+ more voxels of padding",
)
SMALL, FLAT = Grid((4, 5, 6), (0.4, 0.2, 0.21)), Grid((1, 16, 18), (0.4, 0.2, 0.21))
DEEP = Grid((16, 16, 16), (0.5, 0.23, 0.23))
TALL, LOW = Grid((4, 16, 18), (4.0, 0.2, 0.2)), Grid((40, 12, 14), (0.01, 0.2, 0.2))
FAR = Grid((16, 16, 16), (125.0, 1.0, 1.0))
SLAB = Grid((8, 16, 18), (136.5, 2.0, 2.0))
WEDGE = Grid((4, 3, 1092), (273.0, 1.0, 1.0))
SIDEWAYS = Grid((16, 12, 12), (2.0, 0.23, 0.23))
COARSE = Grid((4, 16, 18), (0.4, 0.5, 0.4))
SLOW_LENS = {"na": 0.2, "na_c": 0.05, "sources": ((0.0, 0.0), (0.03, -0.02))}

CASES = [
    # index
    Case("one-voxel step of 0.5", lambda: Scene(half_space(0.5)), refused={"rays": SIDE, "wave": THICK}),
    Case(
        "one-voxel step of 0.5, 512 slabs",
        lambda: Scene(half_space(0.5), options={"steps": 512}),
        rounding=512,  # one a step
        **KINKS,
        gradient_rounding=8192,
        slow=True,
    ),
    Case("one hot voxel of 0.3", lambda: Scene(hot_voxel()), **KINKS, sample=True),
    Case(
        "checkerboard of ±0.05",
        lambda: Scene(checkerboard()),
        **KINKS,
    ),
    Case("negative Δn", lambda: Scene(ball(-0.1, 0.6))),
    Case("Δn of 0 everywhere", lambda: Scene(zeros()), exact=empty_image, sample=True),
    Case("flat beside a sharp edge", lambda: Scene(half_space(0.1)), bright={"wave": 1.02}, **KINKS),
    Case(
        "index below the transverse momentum",
        lambda: Scene(dip(-0.5), sources=(*SOURCES, (0.0, 1.0)), na=1.1, na_c=1.0),
        refused={"projection": TURN, "rays": TURN, "wave": EVANESCENT},
        warned=everywhere((SamplingWarning, "coarser")),
        sample=True,
    ),
    Case(
        "the same without the light that turns",
        lambda: Scene(dip(-0.5)),
        exact=empty_image,
        tolerance=1e-12,
        gradient_rounding=8192,
    ),
    # rays
    Case(
        "grazing light at the condenser's edge",
        lambda: Scene(ball(0.01, 0.6), sources=GRAZING, na=1.3, na_c=1.3),
        warned=everywhere((SamplingWarning, "coarser")),
        gradient_rounding=4096,
    ),
    Case(
        "NA_c of the index − 1e-6, empty",
        lambda: Scene(zeros(), sources=LIMIT, na=1.3, na_c=N0 - 1e-6),
        exact=empty_image,
        step=1e-8,
        alone=("rays",),
        warned=everywhere((SamplingWarning, "coarser")),
    ),
    Case(
        "NA_c of the index − 1e-6",
        lambda: Scene(ball(0.01, 0.6), sources=LIMIT, na=1.3, na_c=N0 - 1e-6),
        step=1e-9,
        refused={"rays": TURN, "wave": THICK},
        warned=everywhere((SamplingWarning, "coarser")),
    ),
    Case(
        "caustic inside",
        lambda: Scene(ball(0.25, 1.0, DEEP, (-2.0, 0.1, 0.2)), DEEP),
        bright={"wave": 1.02},
        sample=True,
    ),
    Case(
        "caustic outside",
        lambda: Scene(ball(0.15, 1.0, DEEP, (2.0, 0.1, 0.2)), DEEP, value(focus=5.6)),
        warned=dict.fromkeys(("projection", "rays"), (WrapAroundWarning, "focus 5.6 µm lies 3.6 µm .* 3 more voxels")),
    ),
    Case(
        "light that leaves sideways",
        lambda: Scene(ball(0.02, 0.6, SIDEWAYS), SIDEWAYS, sources=((0.0, 0.9), (-0.7, 0.6)), na=1.0, na_c=1.0),
        warned=everywhere((SamplingWarning, "coarser")),
        difference=FEW_KINKS,
        gradient_rounding=8192,
    ),
    Case(
        "light trapped in glass",
        lambda: Scene(ramp(0.3, SIDEWAYS), SIDEWAYS),
        refused={"rays": TRAPPED, "wave": THICK},
        sample=True,
    ),
    Case(
        "4096 steps",
        lambda: Scene(smooth(0.02, SMALL), SMALL, options={"steps": 4096}),
        rounding=8192,  # two a step
        gradient_rounding=16384,
        slow=True,
    ),
    Case("512 steps", lambda: Scene(smooth(0.02), options={"steps": 512}), rounding=512, slow=True),
    Case(
        "one step",
        lambda: Scene(smooth(0.005), options={"steps": 1}),
        difference={"rays": 1e-4},
        gradient_rounding=8192,
        sample=True,
    ),
    Case("one voxel thick", lambda: Scene(smooth(0.02, FLAT), FLAT), sample=True),
    Case("voxels of 1:20", lambda: Scene(smooth(0.002, TALL), TALL), rounding=512),
    Case("voxels of 20:1", lambda: Scene(smooth(0.02, LOW), LOW)),
    # phase and float32
    Case(
        "2 mm of medium in front",
        lambda: Scene(periodic_smooth_behind_medium(FAR), FAR, value(focus=900.0), **SLOW_LENS),
        rounding=2048,  # 120 rad at the pupil's edge in each of 32 half slabs
        step=1e-8,
        difference=FEW_KINKS,
        gradient_rounding={"projection": 16384, "rays": 1 << 17, "wave": 16384},
    ),
    Case(
        "wedge of 200 waves",
        lambda: Scene(wedge(WEDGE), WEDGE, **SLOW_LENS, by_propagation={"wave": {"steps": 256}}),
        bright={"rays": 1.02},
        rounding={"projection": 4096, "rays": 8192, "wave": 4096},  # 1257 rad
        step=1e-8,
        difference=FEW_KINKS,
        gradient_rounding=4096,
        cancels=("focus",),  # the rest is 3 % of the terms
        slow=True,
    ),
    Case(
        "OPD of 1000 waves",
        lambda: Scene(
            0.5 + smooth(1e-6, SLAB),
            SLAB,
            na=0.1,
            na_c=0.03,
            sources=((0.0, 0.0), (0.02, -0.01)),
            by_propagation={"wave": {"steps": 1024}},
        ),
        rounding=16384,  # 6283 rad
        step=1e-9,
        difference=FEW_KINKS,
        gradient_rounding=1 << 20,  # of phases of 1e-6·2π/λ·1092 µm = 0.01 rad in 6283
        slow=True,
    ),
    Case("shear of 0", lambda: Scene(smooth(0.02), values=value(shear=(0.0, 0.0)))),
    Case("shear of 1e-9", lambda: Scene(smooth(0.02), values=value(shear=(1e-9, -1e-9)))),
    # 0 in DIC (see tests/test_passband.py), and in the bright field a rounding off 1
    Case("extinction", lambda: Scene(zeros(), values=value(bias=0.0)), exact=empty_image, tolerance=1e-15, sample=True),
    Case("extinction of a specimen", lambda: Scene(smooth(0.02), values=value(bias=0.0))),
    Case("bias of π", lambda: Scene(smooth(0.02), values=value(bias=math.pi))),
    Case(
        "completely dark",
        lambda: Scene(smooth(0.02), values={"absorption": zeros() + 40.0}),
        exact=lambda _: torch.zeros((), dtype=torch.float64),
        tolerance=0.0,
        sample=True,
    ),
    # imaging
    Case(
        "focus 500 µm away",
        lambda: Scene(smooth(0.02), values=value(focus=500.0)),
        rounding=1300,  # k0·500 µm·(n − √(n² − NA²)) in rad
        gradient_rounding=4096,
        warned=everywhere(WRAPS),
    ),
    Case(
        "focus 500 µm away, band-limited",
        lambda: Scene(smooth(0.02), values=value(focus=500.0), options={"band_limit": True}),
        warned=everywhere((WrapAroundWarning, r"focus 500 µm .* of the light leaves the array and is cut")),
    ),
    Case(
        "pupil below a frequency bin",
        lambda: Scene(smooth(0.02), na=0.01, na_c=0.0, sources=((0.0, 0.0),)),
        warned=everywhere((SamplingWarning, r"NA 0.01 is narrower than one frequency .* a side L above 54.6 µm")),
    ),
    Case("NA_c of 0", lambda: Scene(smooth(0.02), na_c=0.0, sources=((0.0, 0.0),))),
    Case(
        "NA_c above NA_o, empty",
        lambda: Scene(zeros(), na=0.3, na_c=0.6, sources=((0.0, 0.1), (0.4, 0.3))),
        exact=empty_image,
    ),
    Case(
        "NA_c above NA_o", lambda: Scene(smooth(0.02), na=0.3, na_c=0.6, sources=((0.0, 0.1), (0.4, 0.3))), sample=True
    ),
    *(
        Case(
            f"{' × '.join(map(str, grid.shape))} voxels",
            lambda grid=grid: Scene(smooth(0.02, grid), grid),
            gradient_rounding=4096,
        )
        for grid in (Grid(n, (0.5, 0.2, 0.21)) for n in [(1, 1, 1), (3, 1, 13), (3, 13, 1), (5, 7, 11), (2, 17, 16)])
    ),
    Case(
        "voxels coarser than the light",
        lambda: Scene(smooth(0.02, COARSE), COARSE),
        warned=everywhere((SamplingWarning, r"voxels of 0.5 µm are coarser than λ/\(2\(NA_o \+ NA_c\)\) = 0.237 µm")),
    ),
    # learnable scalars at 0
    Case(
        "shear, bias and focus of 0",
        lambda: Scene(smooth(0.02), values=value(shear=(0.0, 0.0), bias=0.0, focus=0.0)),
    ),
    Case(
        "aberrations of 0",
        lambda: Scene(smooth(0.02), values=value(**{f"aberration_{i}": 0.0 for i in range(1, 12)})),
        gradient_rounding=8192,  # of the piston, whose terms, some hundreds, add up to 0
    ),
    Case(
        "strain of 0",
        lambda: Scene(
            smooth(0.02), values=value(retardance_6=(0.0, 0.0), retardance_5=(0.0, 0.0), diattenuation_6=(0.0, 0.0))
        ),
    ),
]
