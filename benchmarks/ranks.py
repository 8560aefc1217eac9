"""What processes gain: a bead is reconstructed by several of them, and each one's processor time is measured.

    OMP_NUM_THREADS=1 python benchmarks/ranks.py [--ranks 1 2 4] [--what images newton adam calibrate error-bars]

torchrun starts the processes on this machine. Processor seconds are those of each process after its imports. A process
that waits for others takes none, so rank 0's are about what the run would take by the clock on as many idle cores. The
difference is that of the volume from one process's, the largest and the rms, over the largest and the rms of Δn.
"images" are images of 128 directions with their gradient to the volume, one after the other, and nothing besides. For
"calibrate" the difference is that of each image's brightness, for "error-bars" that of the deviation by noise; both are
of a smaller bead.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

CONFIG = """
[volume]
shape = {shape}
spacing = [0.4, 0.2, 0.2]
background = 1.4
[microscope]
wavelength = 0.546
objective = {{ na = 0.8 }}
condenser = {{ na = 0.6 }}
camera = {{ photons = 3000 }}
[acquisition]
focus = [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]
prisms = [{{ shear = [0.0, 0.24], bias = 1.5 }}, {{ shear = [0.24, 0.0], bias = 1.5 }}]
[specimen]
kind = "bead"
radius = {radius}
contrast = 0.02
[data]
path = "made/stack.ome.tif"
[reconstruction]
method = "{method}"
steps = {steps}
"""
STEPS = {"newton": 12, "adam": 20}
LARGE, SMALL = ([24, 144, 144], 3.5), ([12, 64, 64], 1.6)
FITS = ("calibrate", "error-bars")
IMAGES, DIRECTIONS = 4, 128


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="A reconstruction by several processes.")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4], help="the first is what others differ from")
    parser.add_argument("--what", nargs="+", choices=["images", *STEPS, *FITS], default=["images", *STEPS, *FITS])
    arguments = parser.parse_args()
    print("| what | processes | processor seconds of rank 0 | of each other | in all | largest difference | rms |")
    print("|---|---|---|---|---|---|---|")
    for what in arguments.what:
        first = None
        for ranks in arguments.ranks:
            spent, volume = found(what, ranks)
            first = volume if first is None else first
            off, size = volume - first, np.abs(first).max()
            rms = float(np.sqrt(np.square(off).mean() / np.square(first).mean()))
            others = ", ".join(f"{seconds:.1f}" for seconds in spent[1:]) or "–"
            print(
                f"| {what} | {ranks} | {spent[0]:.1f} | {others} | {sum(spent):.1f} "
                f"| {np.abs(off).max() / size:.1e} | {rms:.1e} |",
                flush=True,
            )


def found(what: str, ranks: int) -> tuple[list[float], np.ndarray]:
    """The processor seconds of each rank, and what its difference is told of."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def run(*words: str) -> None:
            subprocess.run(
                [sys.executable, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )

        words = [what]
        if what != "images":
            method, (shape, radius) = what if what in STEPS else "newton", LARGE if what in STEPS else SMALL
            config = CONFIG.format(shape=shape, radius=radius, method=method, steps=STEPS[method])
            (folder / "run.toml").write_text(config, encoding="utf-8")
            run("-m", "recon", "simulate", "run.toml", "--out", "made")
            words = ["reconstruct" if what in STEPS else what, "run.toml", "--out", "found"]
        if what == "error-bars":
            run("-m", "recon", "reconstruct", "run.toml", "--out", "found")
            words = [what, "found"]
        torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks))
        run(*torchrun, __file__, "--one", *words)
        spent = [json.loads((folder / f"{rank}.json").read_text(encoding="utf-8")) for rank in range(ranks)]
        return spent, left(what, folder)


def left(what: str, folder: Path) -> np.ndarray:
    """What a run has left: Δn or its gradient (z, y, x), its deviation, or the images' brightness (prism, focus)."""
    if what == "images":
        return np.load(folder / "gradient.npy")
    if what == "calibrate":
        told = json.loads((folder / "found" / "calibration.json").read_text(encoding="utf-8"))
        return np.array(told["brightness"]["value"])
    return tifffile.imread(folder / "found" / ("volume.ome.tif" if what in STEPS else "sd.ome.tif"))


def measure(words: list[str]) -> int:
    """Run as one of torchrun's processes, and leave the processor seconds that it took in RANK.json.

    words: a command's, or "images".
    """
    from recon.cli import main as command

    import_all()
    before = time.process_time()
    if words == ["images"]:
        from recon.cli.processes.together import take_part
        from recon.cli.processes.torchrun import place

        of_torchrun = place()
        code = images() if of_torchrun is None else take_part(of_torchrun, images)
    else:
        code = command(words)
    Path(f"{os.environ['RANK']}.json").write_text(json.dumps(time.process_time() - before), encoding="utf-8")
    return code


def images() -> int:
    """Compute images with their gradient, and leave the last one."""
    grid = Grid((24, 144, 144), (0.4, 0.2, 0.2))
    delta = 0.01 * torch.rand(grid.shape, generator=torch.Generator().manual_seed(0))
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.6))
    acquisition = Acquisition((Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), 1.5)), tuple(range(-3, 4)))
    for _ in range(IMAGES):
        delta = delta.detach().requires_grad_()
        formed = image(Volume(grid, delta, 1.4), microscope, acquisition, Fidelity("wave", sources=DIRECTIONS))
        formed.square().sum().backward()
    assert delta.grad is not None
    np.save("gradient.npy", delta.grad.numpy())
    return 0


def import_all() -> None:
    """What the command imports when it is needed."""
    import recon.cli.calibrate
    import recon.cli.evidence.error_bars
    import recon.cli.processes.together
    import recon.cli.reconstruct
    import recon.cli.running  # noqa: F401


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        sys.exit(measure(sys.argv[2:]))
    main()
