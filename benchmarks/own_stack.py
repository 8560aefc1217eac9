"""From ten drawn recordings to their volumes, with nothing typed but what a user knows.

    python benchmarks/own_stack.py [SEED ...] [--out DIR] [--bead]

Each recording is of a specimen, an instrument and faults drawn by `data_synthetic.recorder.drawn`; its light is
computed on finer voxels and from other directions than the fit's. The user runs `torchdic new` on the file, tells
wavelength, NA, medium, bias (up to 10° off) and shear (up to 15 % and 10° off, of unknown sign, with the planes in
unknown order), and then runs `torchdic calibrate` and `torchdic reconstruct`. --bead: she has calibrated her microscope
with a bead before.

"known" is the error of the same file with everything told right, and no calibration. Errors are relative L2 of Δn over
the volume, in which uniform Δn counts too.
"""

import argparse
import contextlib
import io
import json
import math
import sys
import time
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
from torch import Tensor

from data_synthetic import Bead
from data_synthetic.recorder.drawn import Drawn, drawn
from data_synthetic.recorder.record import Recording, record
from data_synthetic.recorder.told import Mistakes, Told, tell
from data_synthetic.recorder.writing import write_recording
from recon.cli import main as torchdic
from recon.config.spelling import canonical
from recon.report.metrics import volume_error
from torchdic import Grid
from torchdic.files.stack import read_volume

# A bead as it is sold for calibration, polystyrene in immersion oil: its radius in µm, its Δn, and the oil's index.
RADIUS, CONTRAST, OIL = 2.0, 0.07, 1.52

HEAD = (
    "| seed | specimen | prisms × planes | told wrong | signs, orders | bias off, ° | shear off, % | axis off, ° "
    "| error | known | ratio | most Δn, of the true | s |\n" + "|---" * 13 + "|"
)


def main() -> int:
    """Print a row for each recording."""
    parser = argparse.ArgumentParser(description="The journey from a file to a volume, on drawn recordings.")
    parser.add_argument("seeds", type=int, nargs="*", default=list(range(10)))
    parser.add_argument("--out", type=Path, default=Path("own_stack"), help="folder for the runs")
    parser.add_argument("--bead", action="store_true", help="the microscope has been calibrated with a bead")
    options = parser.parse_args()
    print(HEAD)
    for seed in options.seeds or range(10):
        print(journey(seed, options.out / f"{seed}{'_bead' if options.bead else ''}", bead=options.bead), flush=True)
    return 0


def journey(seed: int, out: Path, *, bead: bool) -> str:
    """A recording's row of the table. out: folder for its files."""
    out.mkdir(parents=True, exist_ok=True)
    made = drawn(seed)
    recording, told = made.recording, made.told
    began = time.process_time()
    with told_to(out / "log.txt"):
        written = new(made, recording, out, "run")
        values = typed(written, told)
        if bead:
            by_bead(values, made, out)
        path = saved(values, out / "typed.toml")
        ran("calibrate", path, "--out", out / "calibration", "--restart")
        ran("reconstruct", out / "calibration" / "calibrated.toml", "--out", out / "volume", "--restart")
        seconds = time.process_time() - began
        known = saved(typed(written, tell(recording, Mistakes())), out / "known.toml")
        ran("reconstruct", known, "--out", out / "known")
    return row(made, out, seconds)


def new(made: Drawn, recording: Recording, out: Path, name: str) -> dict[str, Any]:
    """What `torchdic new` writes for a recording, as values."""
    suffix = {"ome": ".ome.tif", "imagej": ".tif", "tiff": ".tif"}.get(made.file_kind, "")
    file = out / f"{name}_stack{suffix}"
    if not file.exists():
        write_recording(recording, file, made.file_kind, immersion=made.immersion)
    configuration = out / f"{name}.toml"
    configuration.unlink(missing_ok=True)
    (out / f"{name}.stack.ome.tif").unlink(missing_ok=True)
    ran("new", file, "--out", configuration, "--pixel-size", recording.field.spacing[1])
    return tomllib.loads(configuration.read_text(encoding="utf-8"))


def typed(written: dict[str, Any], told: Told) -> dict[str, Any]:
    """The written values with what the user tells in the place of what was assumed."""
    values = json.loads(json.dumps(written))
    values.pop("assumed", None)
    said = told.config("", (0, 0.0), (0, 0))
    values["acquisition"] = said["acquisition"]
    values["microscope"] |= said["microscope"]
    values["volume"]["background"] = told.background
    values["reconstruction"]["bounds"] = said["reconstruction"]["bounds"]
    return values


def by_bead(values: dict[str, Any], made: Drawn, out: Path) -> None:
    """Put in the prisms that `torchdic calibrate` finds from a stack of a bead by the same microscope."""
    recording = made.recording
    field = recording.field
    middle = float(np.mean([float(z) for z in recording.acquisition.focus]))
    specimen = Bead(RADIUS, CONTRAST, OIL, (middle, 0.1, -0.2))
    seen = record(specimen, field, recording.microscope, recording.acquisition, recording.faults, seed=1)
    of_bead = typed(new(made, seen, out, "bead"), replace(made.told, background=OIL, lower=False))
    of_bead["calibration"] = {"bead": {"radius": RADIUS, "index": OIL + CONTRAST}}
    ran("calibrate", saved(of_bead, out / "bead_typed.toml"), "--out", out / "bead", "--restart")
    found = tomllib.loads((out / "bead" / "microscope.toml").read_text(encoding="utf-8"))
    values["acquisition"]["prisms"] = found["acquisition"]["prisms"]
    values["calibration"] = found["calibration"]


def prisms_and_focus(calibration: Path) -> tuple[list[dict[str, Any]], list[float]]:
    """The prisms, by their shear (y, x) and bias in rad, and the planes that a calibration has left."""
    found = canonical(tomllib.loads((calibration / "calibrated.toml").read_text(encoding="utf-8")))["acquisition"]
    return found["prisms"], found["focus"]


def row(made: Drawn, out: Path, seconds: float) -> str:
    """A recording's line of the table."""
    recording, mistakes = made.recording, made.told.mistakes
    prisms, focus = prisms_and_focus(out / "calibration")
    right = recording.acquisition
    shears = [complex(p["shear"][1], p["shear"][0]) for p in prisms]
    true = [complex(float(p.shear[1]), float(p.shear[0])) for p in right.prisms if p is not None]
    ratio = shears[0] / true[0]
    # shear and bias reversed together give the same image
    sign = 1 if (prisms[0]["bias"] > 0) == (float(right.prisms[0].bias) > 0) else -1  # pyright: ignore[reportOptionalMemberAccess]
    same = (ratio * sign).real > 0 and np.allclose(focus, [float(z) for z in right.focus], atol=1e-3)
    biases = max(
        abs(abs(p["bias"]) - abs(float(q.bias))) for p, q in zip(prisms, right.prisms, strict=True) if q is not None
    )
    turned = math.degrees(np.angle(ratio * sign))
    wrong = [
        f"{math.degrees(mistakes.bias):+.0f}°",
        f"{100 * (mistakes.length - 1):+.0f} %",
        f"{math.degrees(mistakes.turn):+.0f}°",
        *(["sign"] if mistakes.reversed_shear else []),
        *(["order"] if mistakes.reversed_focus else []),
    ]
    errors = [error_of(out / name / "volume.ome.tif", recording) for name in ("volume", "known")]
    most = float(read_volume(out / "volume" / "volume.ome.tif")[0].abs().max() / recording.truth.abs().max())
    cells = (
        str(drawn_seed(out)),
        made.kind,
        f"{recording.data.shape[0]} × {recording.data.shape[1]}",
        ", ".join(wrong),
        "right" if same else "wrong",
        f"{math.degrees(biases):.1f}",
        f"{100 * (abs(ratio) - 1):+.1f}",
        f"{turned:+.1f}",
        f"{errors[0]:.3f}",
        f"{errors[1]:.3f}",
        f"{errors[0] / errors[1]:.2f}",
        f"{most:.2f}",
        f"{seconds:.0f}",
    )
    return "| " + " | ".join(cells) + " |"


def drawn_seed(out: Path) -> int:
    """The seed that names a recording's folder."""
    return int(out.name.partition("_")[0])


def error_of(path: Path, recording: Recording) -> float:
    """Relative L2 error of a volume against the truth, on the slices of the volume."""
    volume, grid = read_volume(path)
    return volume_error(volume, on_slices(recording.truth, recording.field, grid))


def on_slices(truth: Tensor, field: Grid, grid: Grid | None) -> Tensor:
    """The truth's means on slices of another thickness about the same middle."""
    assert grid is not None
    edges = (torch.arange(grid.shape[0] + 1) - grid.shape[0] / 2) * grid.spacing[0]
    known = (torch.arange(field.shape[0] + 1) - field.shape[0] / 2) * field.spacing[0]
    sums = torch.cat([torch.zeros_like(truth[:1]), truth.cumsum(0)]).double() * field.spacing[0]
    flat = sums.flatten(1).numpy()
    at = np.stack([np.interp(edges.numpy(), known.numpy(), column) for column in flat.T], 1)
    means = np.diff(at, axis=0) / grid.spacing[0]
    return torch.from_numpy(means).reshape(grid.shape).float()


def saved(values: dict[str, Any], path: Path) -> Path:
    """A configuration as a file."""
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    return path


def ran(*words: object) -> None:
    """Run a command of torchdic; ends the program where it fails."""
    if words[0] == "reconstruct":
        words = (*words, "--restart")
    code = torchdic([str(word) for word in words])
    if code:
        sys.exit(f"torchdic {' '.join(map(str, words))}: exit code {code}")


@contextlib.contextmanager
def told_to(path: Path) -> Iterator[None]:
    """What commands say goes to a file."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), warnings.catch_warnings():
            yield
    finally:
        path.write_text(said.getvalue(), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
