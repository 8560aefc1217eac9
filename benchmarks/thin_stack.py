"""A thin object in partially coherent light, through focus: rings of condenser directions against a square grid.

    python benchmarks/thin_stack.py [--repeats 7] [--threads 1]

The case is that of tests/data/thin_dic.npz: 129 × 129 pixels, 7 focus planes, 437 directions on a square grid. The
rings have the second moment of those directions, because the grid's steps miss the disc's edge by a little. 4000
directions on rings are as good as the disc, so their difference from the grid shows how much the grid itself errs.

Errors are the rms over the pixels and, in brackets, the largest, in units of the empty bright field. At focus 0 they
are differences from the reference's images. Elsewhere the reference's defocus is paraxial, so they are differences from
our own 437 directions with exact defocus.

The rival is straightforward NumPy: a transform of the object, transfer functions for each source and plane, made
beforehand, and an inverse transform for each source and plane. Times are those of one stack in DIC, by wall clock and
of the process, the least of the repeats, taken in turn.
"""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, image_field

DATA = Path(__file__).parents[1] / "tests" / "data" / "thin_dic.npz"
COUNTS = (18, 24, 32, 36, 40, 80, 120, 4000)


class Case:
    """The reference's object, microscope and images."""

    def __init__(self, name: str, dtype: torch.dtype) -> None:
        with np.load(DATA) as file:
            data = {key: file[key] for key in file.files}
        self.data = data
        self.object = torch.from_numpy(data[f"object_{name}"]).to(dtype)
        self.points = torch.from_numpy(data["source_na_yx"])
        self.na = float((2 * self.points.square().sum(1).mean()).sqrt())
        self.background, self.spacing = float(data["n_medium"]), float(data["spacing"])
        ny, nx = self.object.shape
        self.grid = Grid((1, ny, nx), (1.0, self.spacing, self.spacing))
        self.focus = data["focus_paraxial"].tolist()
        shear = data["shear_yx"].tolist()
        self.prism = Prism((shear[0], shear[1]), float(data["bias"]))
        self.expected = torch.stack([torch.from_numpy(data[f"{kind}_{name}"]) for kind in ("dic", "brightfield")])

    def take(self, condenser: Condenser, prisms: tuple[Prism | None, ...], sources: int = 40) -> Tensor:
        """Images (prism, focus, y, x)."""
        microscope = Microscope(float(self.data["wavelength"]), Objective(float(self.data["na_objective"])), condenser)
        with torch.no_grad():
            return image_field(
                self.object, self.grid, microscope, Acquisition(prisms, self.focus), background=self.background,
                fidelity=Fidelity(sources=sources),
            )  # fmt: skip

    def errors(self, images: Tensor, exact: Tensor) -> list[str]:
        """Errors of DIC and bright field: at focus 0 from the reference, and from `exact` in the worst other plane."""
        at = self.focus.index(0.0)
        focal, elsewhere = images[:, at, None] - self.expected[:, at, None], images - exact
        cells = []
        for error in (*focal, *elsewhere):
            rms, largest = error.square().mean((-1, -2)).sqrt().amax(), error.abs().amax()
            cells.append(f"{float(rms):.1e} ({float(largest):.1e})")
        return cells


class NumPy:
    """The straightforward sum over all directions. What doesn't depend on the object is made beforehand."""

    def __init__(self, case: Case) -> None:
        data, (ny, nx) = case.data, case.object.shape
        wavelength = float(data["wavelength"])
        f = np.stack(np.meshgrid(np.fft.fftfreq(ny, case.spacing), np.fft.fftfreq(nx, case.spacing), indexing="ij"))
        shear = np.tensordot(data["shear_yx"], f, 1)
        prism = 1j * np.sin(np.pi * shear + float(data["bias"]) / 2)
        complex_ = np.complex64 if case.object.dtype == torch.complex64 else np.complex128
        self.transfers = []
        for direction in data["source_na_yx"]:
            squared = ((direction[:, None, None] + wavelength * f) ** 2).sum(0)
            inside = squared <= float(data["na_objective"]) ** 2
            pz = np.sqrt(np.where(inside, case.background**2 - squared, 0))
            pz0 = math.sqrt(case.background**2 - (direction**2).sum())
            for focus in case.focus:
                defocus = np.exp(2j * np.pi / wavelength * focus * (pz - pz0))
                self.transfers.append((inside * prism * defocus).astype(complex_))
        self.object, self.sources, self.planes = case.object.numpy(), len(data["source_na_yx"]), len(case.focus)

    def stack(self) -> np.ndarray:
        """DIC images (focus, y, x)."""
        images = np.zeros((self.planes, *self.object.shape))
        spectrum = np.fft.fft2(self.object)
        for i in range(self.sources):
            for j in range(self.planes):
                images[j] += np.abs(np.fft.ifft2(spectrum * self.transfers[i * self.planes + j])) ** 2
        return images / self.sources


def main() -> None:
    """Print errors and times."""
    parser = argparse.ArgumentParser(description="Rings of condenser directions against a square grid.")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print("| directions | object | DIC at focus 0 | bright field at focus 0 | DIC elsewhere | bright field elsewhere |")
    print("|---|---|---|---|---|---|")
    for name in ("gauss", "asym"):
        case = Case(name, torch.complex128)
        prisms = (case.prism, None)
        exact = case.take(Condenser(case.na, case.points), prisms)
        for label, images in [
            ("437, square grid", exact),
            *((f"{n}, rings", case.take(Condenser(case.na), prisms, n)) for n in COUNTS),
        ]:
            print(f"| {label} | {name} | {' | '.join(case.errors(images, exact))} |")

    case = Case("asym", torch.complex64)
    rival, square = NumPy(case), Condenser(case.na, case.points)
    ways: dict[str, Callable] = {
        "NumPy, 437 directions": rival.stack,
        "torchdic, 437 directions": lambda: case.take(square, (case.prism,)),
        **{
            f"torchdic, {n} on rings": lambda n=n: case.take(Condenser(case.na), (case.prism,), n) for n in (24, 32, 40)
        },
    }
    agreement = np.abs(rival.stack() - case.take(square, (case.prism,))[0].numpy()).max()
    print(f"\nfloat32, {arguments.threads} thread(s); NumPy and torchdic at 437 directions agree to {agreement:.0e}\n")
    print("| one stack of 7 | wall s | process s | faster than NumPy (wall) | (process) |\n|---|---|---|---|---|")
    seconds = {way: [timed(run)] for way, run in ways.items()}
    for _ in range(arguments.repeats - 1):
        for way, run in ways.items():
            seconds[way].append(timed(run))
    least = {way: [min(s) for s in zip(*both, strict=True)] for way, both in seconds.items()}
    slowest = least["NumPy, 437 directions"]
    for way, (wall, process) in least.items():
        print(f"| {way} | {wall:.3f} | {process:.3f} | {slowest[0] / wall:.1f} | {slowest[1] / process:.1f} |")


def timed(run: Callable) -> tuple[float, float]:
    """Seconds of wall clock and of the process's threads together."""
    wall, process = time.perf_counter(), time.process_time()
    run()
    return time.perf_counter() - wall, time.process_time() - process


if __name__ == "__main__":
    main()
