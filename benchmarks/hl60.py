"""A real cell: HL60, whose index a tomogram gives, imaged by a finer model and reconstructed by three methods.

    TORCHDIC_DATA=… python benchmarks/hl60.py [--photons 5000] [--out docs] [--cache DIR] [--no-points]

The folder that TORCHDIC_DATA names must hold ri_hl60_tomogram_derived.npz: Δn on voxels of 0.139 µm, from a Rytov
reconstruction of the ODTbrain examples (CC0). What the tomogram shows is taken as the specimen, blur included; Δn below
0.001 is its noise and its missing cone, and is left out. Light goes along its axis 0.

The stack: two shear axes × bias ±90°, 15 planes of ±7 µm, from voxels of half the reconstruction's sides, with 112
directions, pixels that integrate, and Poisson noise. "error" is the relative L2 error of Δn, over the volume and by
region; "correlation" that of Δn with the true one, over the volume and in the cell; "mass" the sum of Δn over the true
one. "cell, z" is how deep the columns through the cell's middle are above half of its cytoplasm; the nucleolus's
extents are the widths of the profile through its centre at half of its height over the cytoplasm; µm.

Resolution, in two ways. (1) Fourier correlation: of the coefficients of Δn with the true ones in shells of frequency,
within 30° of the axis z and within 30° of the plane across it. The resolution is the period at which it first falls
below 0.5. (2) Droplets (radius 0.25 µm, Δn +0.04) are added to the cell at six places, and both stacks are
reconstructed. The difference of the two volumes, averaged over the places, is the response to a droplet; its widths are
those at half of its maximum. In a third stack two droplets, one above the other, stand at each place; "dip" is how far
the profile between them falls, relative to their mean height. A method with priors resolves a strong droplet better
than what is faint or wide.
"""

import argparse
import hashlib
import math
import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

import reconstruction
import scenes
from data_synthetic import Bead, Specimen
from data_synthetic.specimen import centres
from recon.earlier.path_length import path_length
from recon.earlier.tikhonov import tikhonov
from recon.fit.bounds import Bounds
from recon.fit.problem import measured_noise
from recon.fit.setup import Setup as Before
from recon.fit.setup import empty_medium
from recon.report import figures
from recon.report.metrics import volume_error
from scenes import Scene, Setup
from specimens import Together
from torchdic import Grid
from torchdic.errors import SamplingWarning, WrapAroundWarning

FILE = "ri_hl60_tomogram_derived.npz"
GRID = Grid((44, 104, 104), (0.4, 0.2, 0.2))
FOCUS = tuple(float(z) for z in range(-7, 8))
# Δn below this is the tomogram's noise.
LEAST = 0.001
# Δn that divides the parts, from the tomogram's histogram: the medium from the cell, the nucleus from the cytoplasm,
# and both from the nucleolus.
CELL, NUCLEUS, NUCLEOLUS = 0.010, 0.0185, 0.0255
# Distance in µm of the parts from each other's borders, and of both from the cell's, where the tomogram is blurred.
APART, INSIDE = 0.3, 1.4
DROPLET = Bead(0.25, 0.04, 1.335)
# Places of droplets (z, y, x) in µm: centres of voxels, in cytoplasm and nucleus.
PLACES = (
    (-3.0, -2.1, -2.1),
    (3.0, 2.1, -2.1),
    (-3.0, 2.1, -0.1),
    (3.0, -2.1, 2.1),
    (0.2, -3.9, 0.1),
    (0.2, 0.1, -3.9),
)
# How far apart, in µm along z, the two droplets of each place are.
APARTS = (0.8, 0.8, 1.6, 1.6, 2.4, 2.4)
# Voxels (z, y, x) to each side of a place, over which the response to a droplet is averaged.
AROUND = (5, 6, 6)


@dataclass(frozen=True)
class Tomogram(Specimen):
    """A measured Δn on cubes, cubic splines between their centres, and 0 beyond them and below LEAST.

    delta_measured: (z, y, x). side: of a cube, µm. background: index of the medium. digest: names the values.
    """

    delta_measured: np.ndarray = field(repr=False, compare=False)
    side: float
    background: float
    digest: str

    @classmethod
    def read(cls, path: Path) -> "Tomogram":
        """The tomogram of a file. Raises OSError where it can't be read, and KeyError where it holds something else."""
        with np.load(path) as arrays:
            index, medium, side = arrays["ri"], float(arrays["n_medium"]), float(arrays["voxel_um"])
        digest = hashlib.sha256(index.tobytes()).hexdigest()[:16]
        return cls(index.astype(np.float64) - medium, side, medium, digest)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        delta = torch.from_numpy(self._sampled(self.delta_measured, grid, order=3))
        return torch.where(delta > LEAST, delta, 0)

    def parts(self, grid: Grid) -> dict[str, Bool[Tensor, "z y x"]]:
        """The voxels well inside of each part of the cell, and all of the cell."""
        delta = self.delta_measured
        few = round(APART / self.side)
        cell = _mask(ndimage.binary_fill_holes(delta > CELL))
        inside = _worn(cell, round(INSIDE / self.side))
        nucleolus = _largest(delta > NUCLEOLUS)
        low = _mask(ndimage.gaussian_filter(delta, few) < NUCLEUS)
        nucleus = _largest(_grown(_worn(inside & low, few + 1), few + 1))
        away = ~_grown(nucleolus, 3 * few)
        found = {
            "cytoplasm": inside & away & ~_grown(nucleus, 2 * few),
            "nucleus": away & _worn(nucleus, few),
            "nucleolus": _worn(nucleolus, few),
            "cell": cell,
        }
        sampled = {name: self._sampled(part.astype(np.float32), grid, order=0) for name, part in found.items()}
        return {name: torch.from_numpy(part > 0.5) for name, part in sampled.items()}

    def _sampled(self, values: np.ndarray, grid: Grid, order: int) -> np.ndarray:
        """Values on cubes at the centres of a grid's voxels; 0 beyond."""
        middle = (np.array(values.shape) - 1) / 2
        places = [c.numpy() / self.side + m for c, m in zip(centres(grid), middle, strict=True)]
        return ndimage.map_coordinates(values, np.broadcast_arrays(*places), order=order, mode="constant")


Mask = Bool[np.ndarray, "z y x"]


def _mask(values: object) -> Mask:
    """Values as a mask, whatever SciPy calls their type."""
    return np.asarray(values, dtype=bool)


def _worn(mask: Mask, voxels: int) -> Mask:
    """A mask without its outermost voxels."""
    return _mask(ndimage.binary_erosion(mask, iterations=voxels))


def _grown(mask: Mask, voxels: int) -> Mask:
    """A mask with so many voxels around it."""
    return _mask(ndimage.binary_dilation(mask, iterations=voxels))


def _largest(mask: Mask) -> Mask:
    """The largest connected part of a mask."""
    labels = np.asarray(ndimage.label(mask)[0])  # pyright: ignore[reportIndexIssue]
    return labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))


def stack(specimen: Specimen, photons: float) -> Setup:
    """The cell before the usual microscope: two shear axes, bias ±90°, planes through the whole cell."""
    usual = scenes.acquisition(scenes.SHEARS, (math.pi / 2, -math.pi / 2), FOCUS)
    return Setup("measured", specimen, GRID, acquisition=usual, photons=photons, finer=(2, 2, 2))


def with_droplets(cell: Tomogram) -> Together:
    """The cell with a droplet at each place."""
    droplet = replace(DROPLET, background=cell.background)
    return Together((cell, *(replace(droplet, centre=place) for place in PLACES)))


def with_pairs(cell: Tomogram) -> Together:
    """The cell with two droplets at each place, one above the other."""
    droplet = replace(DROPLET, background=cell.background)
    ends = [(z + side * apart / 2, y, x) for (z, y, x), apart in zip(PLACES, APARTS, strict=True) for side in (-1, 1)]
    return Together((cell, *(replace(droplet, centre=end) for end in ends)))


def newton(scene: Scene) -> Tensor:
    """Δn by the default recipe."""
    found = reconstruction.fit(scene)
    print(f"newton: misfit {found.misfit:.3f} of the noise's after {found.last.number} steps", file=sys.stderr)
    return found.delta


def linear(scene: Scene) -> Tensor:
    """Δn by the linear transfer function, within the scene's bounds."""
    return tikhonov(scene.data, _of_field(scene), measured_noise(scene.data), Bounds(*scene.bounds)).delta


def opl(scene: Scene) -> Tensor:
    """Δn from the optical path lengths of the sections."""
    return path_length(scene.data, _of_field(scene), measured_noise(scene.data)).delta


def _of_field(scene: Scene) -> Before:
    """The empty volume of the field alone: the earlier models have no margin."""
    return Before(empty_medium(scene.grid, scene.background, scene.data), scene.microscope, scene.acquisition)


METHODS: dict[str, Callable[[Scene], Tensor]] = {"newton": newton, "linear": linear, "opl": opl}


def width(profile: Float[Tensor, " n"], spacing: float, base: float = 0.0) -> float:
    """The width at half of the greatest height over a base, between the crossings beside the maximum.

    spacing: of the profile's points, in whose unit the width is. It is infinite where the profile doesn't fall to the
    half on one of its sides.
    """
    height = (profile - base).double()
    peak = int(height.argmax())
    half = float(height[peak]) / 2
    ends = []
    for side in (height[peak:], height[: peak + 1].flip(0)):
        below = (side < half).nonzero()
        if len(below) == 0:
            return math.inf
        k = int(below[0])
        upper, lower = float(side[k - 1]), float(side[k])
        ends.append(k - 1 + (upper - half) / (upper - lower))
    return sum(ends) * spacing


def extent(delta: Tensor, part: Tensor, base: float, axis: int = 0) -> float:
    """The width along an axis, µm, of the profile through a part's centre: the mean over its middle columns."""
    middle = [round(float(index.double().mean())) for index in part.nonzero(as_tuple=True)]
    turned = delta.movedim(axis, 0)
    across = [m for a, m in enumerate(middle) if a != axis]
    columns = turned[:, across[0] - 1 : across[0] + 2, across[1] - 1 : across[1] + 2]
    return width(columns.mean((1, 2)), GRID.spacing[axis], base)


def cell_extent(delta: Tensor, cell: Tensor, cytoplasm: float) -> float:
    """How deep the cell is, µm: the columns at its centre are above half of its cytoplasm from one end to the other."""
    middle = [round(float(index.double().mean())) for index in cell.nonzero(as_tuple=True)]
    profile = delta[:, middle[1] - 2 : middle[1] + 3, middle[2] - 2 : middle[2] + 3].mean((1, 2))
    inside = (profile > cytoplasm / 2).nonzero().flatten()
    return 0.0 if len(inside) == 0 else float(inside[-1] - inside[0] + 1) * GRID.spacing[0]


def row(name: str, delta: Tensor, truth: Tensor, parts: dict[str, Tensor], seconds: float | None) -> str:
    """A volume's line of the table."""
    cell = parts["cell"]
    means = {part: float(delta[parts[part]].mean()) for part in ("cytoplasm", "nucleus", "nucleolus")}
    everywhere = torch.ones_like(cell)
    correlations = [float(torch.corrcoef(torch.stack([delta[p], truth[p]]))[0, 1]) for p in (everywhere, cell)]
    regions = [f"{mean:.4f} ({volume_error(delta * parts[p], truth * parts[p]):.2f})" for p, mean in means.items()]
    cells = (
        name,
        f"{volume_error(delta, truth):.3f}",
        *(f"{correlation:.3f}" for correlation in correlations),
        f"{float(delta.sum() / truth.sum()):.2f}",
        *regions,
        f"{cell_extent(delta, cell, means['cytoplasm']):.1f}",
        f"{extent(delta, parts['nucleolus'], means['cytoplasm']):.1f}",
        f"{extent(delta, parts['nucleolus'], means['cytoplasm'], axis=2):.1f}",
        *(f"{period:.2f}" for period in resolutions(delta, truth)),
        "" if seconds is None else f"{seconds:.0f}",
    )
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| | error | correlation | in the cell | mass | cytoplasm | nucleus | nucleolus "
    "| cell, z | nucleolus, z | nucleolus, x | resolution, z | across | s |\n" + "|---" * 14 + "|"
)


# Fourier correlation: the shells' thickness in 1/µm, the angle in rad, and where detail counts as lost.
SHELL, CONE, LOST = 0.06, math.radians(30), 0.5


def resolutions(delta: Tensor, truth: Tensor) -> tuple[float, float]:
    """The shortest periods in µm, along z and across, down to which Δn's Fourier coefficients are like the true ones.

    M. van Heel and M. Schatz, J. Struct. Biol. 151, 250 (2005), for the correlation of shells.
    """
    found, true = (torch.fft.fftn(v.double()) for v in (delta, truth))
    fz, fy, fx = (torch.fft.fftfreq(n, s, dtype=torch.float64) for n, s in zip(GRID.shape, GRID.spacing, strict=True))
    across = torch.hypot(fy[:, None], fx[None, :])[None]
    along = fz.abs()[:, None, None]
    shell = (torch.hypot(along, across) / SHELL).long()
    angle = torch.atan2(across, along)
    cones = angle <= CONE, angle >= math.pi / 2 - CONE
    return _lost(found, true, shell, cones[0]), _lost(found, true, shell, cones[1])


def _lost(found: Tensor, true: Tensor, shell: Tensor, cone: Tensor) -> float:
    """The period of the first shell whose correlation within a cone is below LOST."""
    most = int(0.5 / max(GRID.spacing) / SHELL)
    for number in range(1, most):
        chosen = cone & (shell == number)
        if not bool(chosen.any()):
            continue
        a, b = found[chosen], true[chosen]
        correlation = float((a * b.conj()).real.sum() / (a.norm() * b.norm()).clamp_min(1e-30))
        if correlation < LOST:
            return 1 / ((number + 0.5) * SHELL)
    return 1 / (most * SHELL)


def voxel(place: tuple[float, float, float]) -> tuple[int, int, int]:
    """The voxel (z, y, x) whose centre is at a place in µm."""
    z, y, x = (round(p / s + (n - 1) / 2) for p, s, n in zip(place, GRID.spacing, GRID.shape, strict=True))
    return z, y, x


def response(change: Tensor) -> Float[Tensor, "z y x"]:
    """The mean of a change of Δn about the places of the droplets."""
    found = []
    for place in PLACES:
        z, y, x = (slice(at - r, at + r + 1) for at, r in zip(voxel(place), AROUND, strict=True))
        found.append(change[z, y, x])
    return torch.stack(found).mean(0)


def dip(change: Tensor, apart: float) -> float:
    """How far a change of Δn falls between two droplets, relative to their mean height; over all pairs so far apart."""
    profiles = []
    for place, distance in zip(PLACES, APARTS, strict=True):
        if distance == apart:
            z, y, x = voxel(place)
            half = round(apart / 2 / GRID.spacing[0])
            profiles.append(change[z - half : z + half + 1, y, x])
    mean = torch.stack(profiles).mean(0)
    height = float((mean[0] + mean[-1]) / 2)
    return 1 - float(mean.min()) / height if height > 0 else 0.0


def point_row(name: str, single: Tensor, pairs: Tensor, true: Tensor) -> str:
    """What changes of Δn say of the resolution: a line of its table.

    single, pairs: the changes by a droplet and by two at each place. true: the true one by a droplet.
    """
    mean, (kz, ky, kx) = response(single), AROUND
    dz, dy, dx = GRID.spacing
    widths = (width(mean[:, ky, kx], dz), width(mean[kz, :, kx], dy), width(mean[kz, ky], dx))
    peak = float(mean[kz, ky, kx]) / float(response(true)[kz, ky, kx])
    mass = float(mean.sum() / response(true).sum())
    dips = (dip(pairs, apart) for apart in dict.fromkeys(APARTS))
    numbers = (*widths, peak, mass, *dips)
    return f"| {name} | " + " | ".join(f"{number:.2f}" for number in numbers) + " |"


POINT_HEAD = (
    "| droplet | z | y | x | maximum | mass | "
    + " | ".join(f"dip, {apart} µm" for apart in dict.fromkeys(APARTS))
    + " |\n"
    + "|---" * (6 + len(dict.fromkeys(APARTS)))
    + "|"
)


def compare(options: argparse.Namespace, tomogram: Tomogram) -> None:
    """Print both tables, and draw the sections."""
    cache = options.cache or scenes.default_cache()
    scene = stack(tomogram, options.photons).scene("HL60", cache)
    parts = tomogram.parts(GRID)
    print(f"{options.photons:g} photons, noise {scene.noise_misfit:.3g} of the misfit\n\n{HEAD}")
    print(row("truth", scene.truth, scene.truth, parts, None), flush=True)
    volumes = {"truth": scene.truth}
    for name, solve in METHODS.items():
        began = time.process_time()
        volumes[name] = solve(scene)
        print(row(name, volumes[name], scene.truth, parts, time.process_time() - began), flush=True)
    through = [round(float(index.double().mean())) for index in parts["nucleolus"].nonzero(as_tuple=True)]
    drawn = figures.draw_sections(volumes, GRID, ("xy", "xz"), (through[0], through[1], through[2]))
    figures.leave(drawn, options.out / "hl60.png")
    if not options.points:
        return
    more = stack(with_droplets(tomogram), options.photons).scene("HL60 with droplets", cache)
    twice = stack(with_pairs(tomogram), options.photons).scene("HL60 with pairs", cache)
    true = more.truth - scene.truth
    print(f"\n{POINT_HEAD}\n" + point_row("truth", true, twice.truth - scene.truth, true), flush=True)
    for name in ("newton", "linear"):
        single, pairs = (METHODS[name](changed) - volumes[name] for changed in (more, twice))
        print(point_row(name, single, pairs, true), flush=True)


def main() -> int:
    """Compare the methods on the tomogram; 2 where it isn't there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photons", type=float, default=5000.0, help="per pixel of the empty bright field")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder for the figure")
    parser.add_argument("--cache", type=Path, default=None, help="folder of the noiseless images")
    parser.add_argument("--no-points", dest="points", action="store_false", help="leave out the resolution")
    options = parser.parse_args()
    folder = os.environ.get("TORCHDIC_DATA")
    if not folder:
        print(f"hl60.py: error: TORCHDIC_DATA is unset: it names the folder that holds {FILE}", file=sys.stderr)
        return 2
    try:
        tomogram = Tomogram.read(Path(folder) / FILE)
    except (OSError, KeyError) as error:
        print(f"hl60.py: error: {Path(folder) / FILE}: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    for category in (SamplingWarning, WrapAroundWarning):
        warnings.simplefilter("ignore", category)
    compare(options, tomogram)
    return 0


if __name__ == "__main__":
    sys.exit(main())
