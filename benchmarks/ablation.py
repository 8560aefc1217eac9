"""What each part of the ray and wave propagation is worth, on the exact smooth ball of tests/data/exact_ball_dic.npz.

    python benchmarks/ablation.py

A row for the method and for the method with one part changed; the error is the rms difference from the exact image
over that image's standard deviation, at each focus plane. The reference was made on a periodic array of 256 × 256
pixels and cropped to 128, so the model is run on as many.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from unittest import mock

import numpy as np
import torch
from torch import Tensor

from data_synthetic import GaussianBall
from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    Volume,
    image,
    image_field,
    landing,
)
from torchdic.rays import Deviation, axial_momentum
from torchdic.wave import axial_difference, exp_i, slab_mean, to_field, to_spectrum

DATA = Path(__file__).parents[1] / "tests" / "data"
DEPTH = 18.0
PADDING = 64

Name = Literal["rays", "no p_z", "no amplitude", "at the exit", "textbook screen", "split step"]


@dataclass(frozen=True, eq=False)
class Scene:
    """The exact images (prism, focus, y, x), what they show, and how they were taken."""

    images: Tensor
    ball: GaussianBall
    spacing: float
    microscope: Microscope
    acquisition: Acquisition

    def volume(self, slices: int) -> Volume:
        """The ball in float32 on `slices` slices of DEPTH."""
        ny, nx = self.images.shape[2:]
        grid = Grid((slices, ny, nx), (DEPTH / slices, self.spacing, self.spacing))
        return Volume(grid, self.ball.delta(grid, dtype=torch.float32), self.ball.background)

    def errors(self, images: Tensor) -> list[float]:
        """The largest error over the prisms at each focus plane."""
        difference = (images - self.images).square().mean((2, 3)).sqrt()
        return (difference / self.images.std((2, 3), correction=0)).amax(0).tolist()


def read() -> Scene:
    with np.load(DATA / "exact_ball_dic.npz") as file:
        data = {key: file[key] for key in file.files}
    n0 = float(data["n_medium"])
    points = torch.from_numpy(data["source_yx"]) * n0
    condenser = Condenser(float(points.norm(dim=1).max()), points)
    prisms = [Prism((float(s[0]), float(s[1])), float(b)) for s, b in zip(data["shear_yx"], data["bias"], strict=True)]
    return Scene(
        torch.from_numpy(data["images"]),
        GaussianBall(float(data["sigma"]), float(data["delta_peak"]), n0),
        float(data["spacing"]),
        Microscope(float(data["wavelength"]), Objective(float(data["na_objective"])), condenser),
        Acquisition(prisms, [float(f) for f in data["focus"]]),
    )


@contextmanager
def without_axial_momentum() -> Iterator[None]:
    """Rays of amplitude 1/√|det ∂x_r/∂x0|: `ray_field` with its factor p_z/p_z0 divided out again."""
    slants: list[Tensor] = []
    extend, tube_area = landing.extend, landing.tube_area

    def extended(rays: Deviation, p0: Tensor, n0: Tensor, distance: float) -> Deviation:
        landed = extend(rays, p0, n0, distance)
        slants.append(axial_momentum(n0, p0 + landed.momentum) / axial_momentum(n0, p0))
        return landed

    def area(displacement: Tensor, grid: Grid) -> Tensor:
        return tube_area(displacement, grid) / slants.pop()

    with mock.patch.object(landing, "extend", extended), mock.patch.object(landing, "tube_area", area):
        yield


def textbook_screen(volume: Volume, wavelength: float, momentum: Tensor, steps: int) -> Tensor:
    """Spectrum (source, y, x) on the last face by the textbook's split step: one screen k0·Δn·dz/cosθ a slab."""
    dz, k0, n0 = volume.grid.extent[0] / steps, 2 * math.pi / wavelength, volume.background
    cosine = axial_momentum(n0, momentum)[:, None, None] / n0
    difference, pz = axial_difference(volume.grid, wavelength, n0, momentum)
    H = torch.where(pz > 0, exp_i(k0 * dz / 2 * difference), 0)
    slices = volume.delta.unbind(0)
    S = torch.zeros_like(H)
    S[:, 0, 0] = 1
    for step in range(steps):
        S = H * to_spectrum(exp_i(k0 * dz * slab_mean(slices, step, steps) / cosine) * to_field(S * H))
    return S


def textbook_images(volume: Volume, scene: Scene, padding: int, steps: int) -> Tensor:
    """Images of the textbook's split step: its field, taken back to z = 0 in the background, as a transmission."""
    grid = replace(volume.grid, shape=(volume.grid.shape[0], *(n + 2 * padding for n in volume.grid.shape[1:])))
    wide = Volume(grid, torch.nn.functional.pad(volume.delta, (padding,) * 4), volume.background)
    momentum, _ = scene.microscope.sources(Fidelity("wave"), dtype=wide.delta.dtype, device=wide.delta.device)
    spectrum = textbook_screen(wide, scene.microscope.wavelength, momentum, steps)
    difference, _ = axial_difference(grid, scene.microscope.wavelength, wide.background, momentum)
    k0 = 2 * math.pi / scene.microscope.wavelength
    field = to_field(spectrum * exp_i(-k0 * grid.extent[0] / 2 * difference))
    images = image_field(field, grid, scene.microscope, scene.acquisition, background=volume.background)
    return images if padding == 0 else images[..., padding:-padding, padding:-padding]


def ablation(name: Name, scene: Scene, slices: int, rays: Fidelity, padding: int) -> list[float]:
    """Errors at each focus plane; `rays` is how the ray rows trace, `slices` how finely the volume is cut."""
    volume = scene.volume(slices)
    trials: dict[Name, Callable[[], Tensor]] = {
        "rays": lambda: image(volume, scene.microscope, scene.acquisition, rays),
        "no amplitude": lambda: image(volume, scene.microscope, scene.acquisition, replace(rays, amplitude=False)),
        "at the exit": lambda: image(
            volume, scene.microscope, scene.acquisition, replace(rays, reference_plane=DEPTH / 2)
        ),
        "textbook screen": lambda: textbook_images(volume, scene, padding, slices),
        "split step": lambda: image(volume, scene.microscope, scene.acquisition, Fidelity("wave", padding=padding)),
    }
    trials["no p_z"] = trials["rays"]
    with torch.no_grad(), without_axial_momentum() if name == "no p_z" else nullcontext():
        return scene.errors(trials[name]())


def main() -> None:
    """Print the table."""
    scene = read()
    fine = Fidelity("rays", padding=PADDING, interpolation="linear")
    rows: list[tuple[str, Name, int, Fidelity]] = [
        ("rays, amplitude √(p_z0/(p_z |det|))", "rays", 120, fine),
        ("rays, the same, spline", "rays", 120, replace(fine, interpolation="cubic", steps=60)),
        ("rays, 1/√|det| without p_z", "no p_z", 120, fine),
        ("rays, no amplitude", "no amplitude", 120, fine),
        ("rays, reference plane at the exit", "at the exit", 120, fine),
        ("split step, screen k0·Δn·dz/cosθ, 1 µm", "textbook screen", 18, fine),
        ("split step, screen k0·Δn·dz/cosθ, 0.15 µm", "textbook screen", 120, fine),
        ("split step, corrected, 1 µm", "split step", 18, fine),
    ]
    focus = "  ".join(f"z={float(f):+.0f} µm" for f in scene.acquisition.focus)
    print(f"{'':<44}{focus}   seconds")
    for label, name, slices, rays in rows:
        start = time.perf_counter()
        row = "  ".join(f"{e:8.4f}" for e in ablation(name, scene, slices, rays, PADDING))
        print(f"{label:<44}{row}   {time.perf_counter() - start:7.1f}", flush=True)


if __name__ == "__main__":
    main()
