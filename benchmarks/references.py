"""The model against images with a known answer, tests/data/*.npz.

    python benchmarks/references.py

- A thin object, imaged by microlith (Mehta & Oldenbourg 2014): the largest error at each focus plane, in units of the
    empty bright field. microlith's defocus is paraxial, and it sums in single precision.
- A smooth ball and a sharp bead, whose exact fields are sums of partial waves: the rms difference over the image's
    standard deviation, at each focus plane.
"""

import time
from collections.abc import Sequence

import torch

from comparison import header, row, trial
from stored import PADDING, Scene, load, microscope, sharp_bead, smooth_ball
from torchdic import Acquisition, Fidelity, Grid, Prism, image_field


def main() -> None:
    """Print the tables."""
    print("thin objects, 437 directions to NA 0.50 in 1.33; largest error of the empty bright field\n")
    thin_object()
    print("\nsmooth ball, σ 2 µm, Δn 0.03 in 1.36, 21 directions to NA 0.54 (float32)\n")
    solid(smooth_ball(), [("projection", 120), ("rays", 120), ("wave", 18), ("wave", 120)])
    print("\nsharp bead, 10 µm, Δn 0.03 in 1.56, 37 directions to NA 0.45 (float32)\n")
    solid(sharp_bead(), [("projection", 80), ("rays", 80), ("wave", 40), ("wave", 80), ("wave", 160)])


def thin_object() -> None:
    """A row for each object, kind of image and defocus."""
    data = load("thin_dic")
    points = torch.from_numpy(data["source_na_yx"])
    shear = tuple(float(s) for s in data["shear_yx"])
    kinds = {"dic": Prism((shear[0], shear[1]), float(data["bias"])), "brightfield": None}
    names = {"gauss": "smooth", "asym": "asymmetric", "dic": "DIC", "brightfield": "bright field"}
    focus = [float(f) for f in data["focus_paraxial"]]
    print(header(("object", "image", "defocus"), focus))
    for specimen in ("gauss", "asym"):
        transmission = torch.from_numpy(data[f"object_{specimen}"])
        (ny, nx), dx = transmission.shape, float(data["spacing"])
        grid = Grid((1, ny, nx), (1.0, dx, dx))
        for kind, prism in kinds.items():
            expected = torch.from_numpy(data[f"{kind}_{specimen}"])
            for defocus in ("paraxial", "exact"):
                start = time.perf_counter()
                with torch.no_grad():
                    images = image_field(
                        transmission,
                        grid,
                        microscope(data, points),
                        Acquisition([prism], focus),
                        background=float(data["n_medium"]),
                        fidelity=Fidelity(defocus=defocus),
                    )
                seconds = time.perf_counter() - start
                errors = (images[0] - expected).abs().amax((1, 2)).tolist()
                print(row((names[specimen], names[kind], defocus), errors, seconds, digits=".1e"), flush=True)


def solid(scene: Scene, trials: Sequence[tuple[str, int]]) -> None:
    """A row for each (propagation, slices)."""
    print(header(("propagation", "slice"), scene.acquisition.focus))
    for propagation, slices in trials:
        volume, fidelity = scene.volume(slices), Fidelity(propagation, padding=PADDING)
        errors, seconds = trial(volume, scene.microscope, scene.acquisition, fidelity, scene.images)
        print(row((propagation, f"{volume.grid.spacing[0]:.4g} µm"), errors, seconds), flush=True)


if __name__ == "__main__":
    main()
