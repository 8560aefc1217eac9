"""A stack to try torchdic on: a cell, as a camera stores it, in a file as a microscope's program leaves it.

    python experiments/own_stack.py --out DIR

It leaves DIR/cell.ome.tif: 4 prism settings × 13 focus planes of 72×80 pixels, 16 bits, with a tilted lamp, hot pixels
and a slow drift. The shear is 0.2 µm long and points 30° from right towards down, and in the other two settings across
it; the bias is ±80°. `docs/own_stack.md` goes from there to the volume.
"""

import argparse
import math
import sys
from pathlib import Path

from data_synthetic import CellPhantom
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Recording, record
from data_synthetic.recorder.writing import write_recording
from torchdic import Acquisition, Camera, Condenser, Grid, Microscope, Objective, Prism
from torchdic.files.stack import write_volume

FIELD = Grid((24, 72, 80), (0.35, 0.15, 0.15))
CAMERA = Camera(photons=8000, read_noise=2.0, gain=2.0, offset=100.0, bits=16)
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7), CAMERA)
FAULTS = Faults(tilt=(0.1, -0.15), flicker=0.01, drift=(0.006, -0.004), hot=7, dead=2)
SHEAR, ANGLE, BIAS = 0.2, math.radians(30), math.radians(80)


def acquisition() -> Acquisition:
    """Two shears across one another, each with the bias and its opposite, in thirteen planes."""
    shears = [(SHEAR * math.sin(a), SHEAR * math.cos(a)) for a in (ANGLE, ANGLE + math.pi / 2)]
    return Acquisition(
        [Prism(shear, bias) for shear in shears for bias in (BIAS, -BIAS)], [0.5 * i for i in range(-6, 7)]
    )


def recorded() -> Recording:
    """The stack and all that is true of it."""
    return record(CellPhantom(), FIELD, MICROSCOPE, acquisition(), FAULTS, seed=2)


def main() -> int:
    """Write the stack, and the cell's true Δn beside it."""
    parser = argparse.ArgumentParser(description="Record a cell as a camera stores it.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the stack")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    recording = recorded()
    print(write_recording(recording, out / "cell.ome.tif", immersion=1.0))
    write_volume(out / "truth.ome.tif", recording.truth, FIELD)
    return 0


if __name__ == "__main__":
    sys.exit(main())
