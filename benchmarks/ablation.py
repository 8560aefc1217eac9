"""What each part of the ray and wave propagation is worth, on the exact smooth ball of tests/data/exact_ball_dic.npz.

    python benchmarks/ablation.py

There is a row for each method, and one for the method with a single part changed. The error is the rms difference from
the exact image over that image's standard deviation, at each focus plane. The model runs on the reference's periodic
array.

Further tables show the specimen's own defocus of each object point, Kagalwala & Kanade's Eq. 6, on the smooth ball and
on the sharp bead of tests/data/exact_sphere_dic.npz, without padding. They show what it gains for straight and bent
rays without amplitude. They also show what it does to rays with amplitude, a combination that `Fidelity` refuses.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Literal
from unittest import mock

import torch
from torch import Tensor

from comparison import header, row
from stored import PADDING, Scene, sharp_bead, smooth_ball
from torchdic import Fidelity, Grid, Volume, image, image_field
from torchdic.fidelity import AberrationMethod
from torchdic.imaging.intensity import Imaging
from torchdic.imaging.passband import interpolate
from torchdic.object_aberration.levels import levels
from torchdic.object_aberration.wavefront import effective_defocus
from torchdic.plane_waves import axial_difference, axial_momentum, exp_i, to_field, to_spectrum
from torchdic.propagation.base import propagation_of
from torchdic.propagation.split_step import slab_mean
from torchdic.rays import landing
from torchdic.rays.trace import Deviation

Name = Literal["rays", "no p_z", "no amplitude", "at the exit", "textbook screen", "split step"]


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
    """Images of the textbook's split step. Its field is taken back to z = 0 in the background, as a transmission."""
    grid = replace(volume.grid, shape=(volume.grid.shape[0], *(n + 2 * padding for n in volume.grid.shape[1:])))
    wide = Volume(grid, torch.nn.functional.pad(volume.delta, (padding,) * 4), volume.background)
    momentum, _ = scene.microscope.sources(Fidelity("wave").sources, dtype=wide.delta.dtype, device=wide.delta.device)
    spectrum = textbook_screen(wide, scene.microscope.wavelength, momentum, steps)
    difference, _ = axial_difference(grid, scene.microscope.wavelength, wide.background, momentum)
    k0 = 2 * math.pi / scene.microscope.wavelength
    field = to_field(spectrum * exp_i(-k0 * grid.extent[0] / 2 * difference))
    images = image_field(field, grid, scene.microscope, scene.acquisition, background=volume.background)
    return images if padding == 0 else images[..., padding:-padding, padding:-padding]


def ablation(name: Name, scene: Scene, slices: int, rays: Fidelity, padding: int) -> list[float]:
    """Errors at each focus plane. rays: how the ray rows are traced. slices: into how many the volume is cut."""
    volume = scene.volume(slices)
    trials: dict[Name, Callable[[], Tensor]] = {
        "rays": lambda: image(volume, scene.microscope, scene.acquisition, rays),
        "no amplitude": lambda: image(volume, scene.microscope, scene.acquisition, replace(rays, amplitude=False)),
        "at the exit": lambda: image(
            volume, scene.microscope, scene.acquisition, replace(rays, reference_plane=scene.depth / 2)
        ),
        "textbook screen": lambda: textbook_images(volume, scene, padding, slices),
        "split step": lambda: image(volume, scene.microscope, scene.acquisition, Fidelity("wave", padding=padding)),
    }
    trials["no p_z"] = trials["rays"]
    with torch.no_grad(), without_axial_momentum() if name == "no p_z" else nullcontext():
        return scene.errors(trials[name]())


def own_defocus(scene: Scene, slices: int, rays: Fidelity, method: AberrationMethod, times: float = 1.0) -> list[float]:
    """Errors of a field of rays whose points spread with `times` their own defocus.

    It does what `image` does, and also what `image` refuses: rays with amplitude, which have the defocus already.
    """
    volume, microscope = scene.volume(slices), scene.microscope
    assert microscope.condenser is not None
    assert microscope.objective is not None
    plane, n0 = volume.mean_plane(), volume.background
    momentum, weights = microscope.sources(rays.sources, dtype=torch.float32, device=volume.delta.device)
    half_angle = math.asin(microscope.condenser.na / float(n0)) if method == "cone" else None
    careful = Fidelity("rays", interpolation="cubic", steps=rays.steps)
    with torch.no_grad():
        defocus = times * effective_defocus(volume, plane, fidelity=careful, method=method, half_angle=half_angle)
        rate = float(n0 - (n0**2 - microscope.objective.na**2).sqrt()) * 2 * math.pi / microscope.wavelength
        difference, _ = axial_difference(volume.grid, microscope.wavelength, n0, momentum)
        own = levels(defocus, rate)
        crossing = propagation_of(rays).prepare(volume, rays, plane)
        spectrum = crossing.spectrum(
            microscope.wavelength,
            momentum,
            to_spectrum=lambda field: own.spread(field, microscope.wavelength, difference),
        )
        imaging = Imaging(volume.grid, n0, plane, microscope, scene.acquisition)
        images = imaging.intensity(spectrum, momentum, weights)
    return scene.errors(interpolate(images, (volume.grid.shape[1], volume.grid.shape[2])))


def print_row(label: str, errors: Callable[[], list[float]]) -> None:
    """A row of the table, and how long it took."""
    start = time.perf_counter()
    found = errors()
    print(row((label,), found, time.perf_counter() - start), flush=True)


def print_own_defocus(title: str, scene: Scene, slices: int) -> None:
    """The table of Eq. 6 for one specimen."""
    straight = Fidelity("projection", steps=40)
    bent = Fidelity("rays", steps=40, amplitude=False)
    print_head(f"Eq. 6, {title}", scene)
    for name, rays in (("straight rays", straight), ("bent rays, no amplitude", bent)):
        for label, fidelity in (
            (name, rays),
            (f"{name}, Eq. 6 linear", replace(rays, object_aberration="linear")),
            (f"{name}, Eq. 6 cone", replace(rays, object_aberration="cone")),
        ):
            print_row(label, lambda fidelity=fidelity: whole(scene, slices, fidelity))
    print_row("straight rays, Eq. 6 cone, twice its defocus", lambda: own_defocus(scene, slices, straight, "cone", 2.0))
    with_ = replace(bent, amplitude=True)
    print_row("bent rays with amplitude", lambda: whole(scene, slices, with_))
    for method in ("linear", "cone"):
        print_row(f"the same and Eq. 6 {method}", lambda method=method: own_defocus(scene, slices, with_, method))


def whole(scene: Scene, slices: int, fidelity: Fidelity) -> list[float]:
    """Errors of `image` itself."""
    with torch.no_grad():
        return scene.errors(image(scene.volume(slices), scene.microscope, scene.acquisition, fidelity))


def print_head(title: str, scene: Scene) -> None:
    """The table's title and first line."""
    print(f"\n{title}\n")
    print(header(("propagation",), scene.acquisition.focus))


def main() -> None:
    """Print the tables."""
    scene = smooth_ball()
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
    print_head("smooth ball", scene)
    for label, name, slices, rays in rows:
        print_row(label, lambda name=name, slices=slices, rays=rays: ablation(name, scene, slices, rays, PADDING))
    print_own_defocus("smooth ball", scene, 120)
    print_own_defocus("sharp bead", sharp_bead(), 80)


if __name__ == "__main__":
    main()
