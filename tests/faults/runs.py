"""Reconstructions in processes of their own, into which something breaks; what they lose, and what they say."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import tifffile
import torch
from results import RESULTS

# A module, or in place of it a script that breaks something and runs the module.
TORCHDIC = ("-m", "recon")
HERE = Path(__file__).parent
# Of all processes: few threads, and this tree's modules, wherever a script is.
ENV = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(HERE.parents[1])}

# A warning or an error, wherever in a line the progress bar has left it.
SAID = re.compile(r"torchdic[\w -]*: ((?:warning|error): .*)")

FOLDERS = re.compile(r"(?<!\w)/(?:[^\s/:;]+/)+")

EVERY = 3  # steps between two checkpoints
CONFIG = f"""
[volume]
shape = [8, 48, 44]
spacing = [0.5, 0.2, 0.2]
background = 1.4
[microscope]
wavelength = 0.546
objective = {{ na = 0.8 }}
condenser = {{ na = 0.5 }}
camera = {{ photons = 3000 }}
[acquisition]
focus = [-1.0, 0.0, 1.0]
prisms = [{{ shear = [0.0, 0.24], bias = 1.5 }}, {{ shear = [0.24, 0.0], bias = 1.5 }}]
[specimen]
kind = "bead"
radius = 1.0
contrast = 0.03
[data]
path = "stack.ome.tif"
[fidelity]
sources = 72
[reconstruction]
checkpoint_every = {EVERY}
"""


@dataclass(frozen=True)
class Launch:
    """How a reconstruction is started.

    start: the words before a module or script, such as `torchrun --nproc-per-node=2`. options: of `reconstruct`.
    config: the configuration.
    """

    start: tuple[str, ...] = (sys.executable,)
    options: tuple[str, ...] = ()
    config: str = CONFIG


# Each fault befalls each of them.
LAUNCHES = {"one process": Launch()}


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit code, the lines that it said (warnings and errors), and the seconds that it took."""

    code: int
    said: list[str]
    seconds: float
    output: str = ""


@dataclass(frozen=True)
class Scene:
    """A folder with a configuration and its stack, and the results of a run to which nothing happened.

    folder: holds both; `whole` the results. seconds: that the run took.
    """

    folder: Path
    launch: Launch
    seconds: float

    @property
    def whole(self) -> Path:
        return self.folder / "whole"

    @classmethod
    def made(cls, folder: Path, launch: Launch) -> "Scene":
        (folder / "run.toml").write_text(launch.config, encoding="utf-8")
        scene = cls(folder, launch, 0.0)
        simulate = [sys.executable, *TORCHDIC, "simulate", folder / "run.toml", "--out", folder / "made"]
        subprocess.run(simulate, check=True, capture_output=True, env=ENV)
        shutil.copy(folder / "made" / "stack.ome.tif", folder)
        ended = scene.run(scene.whole)
        assert ended.code == 0, ended.output
        return cls(folder, launch, ended.seconds)

    @contextmanager
    def started(self, out: Path, *options: str, by: tuple[str, ...] = TORCHDIC) -> Iterator["Running"]:
        """A run into a folder; whatever is left of it at the end of the block is killed."""
        words = ["reconstruct", self.folder / "run.toml", "--out", out, *self.launch.options, *options]
        running = Running([*self.launch.start, *by, *map(str, words)], out)
        try:
            yield running
        finally:
            running.kill()

    def run(self, out: Path, *options: str, by: tuple[str, ...] = TORCHDIC) -> Ended:
        """A run to its end."""
        with self.started(out, *options, by=by) as running:
            return running.ended()

    def check_as_whole(self, out: Path) -> None:
        """What is in a folder is what the run to which nothing happened has left."""
        names = {path.name for path in out.iterdir()} - {".lock"}  # of a run that was killed
        assert names == RESULTS
        for name in ("volume.ome.tif", "images.ome.tif"):
            assert (tifffile.imread(out / name) == tifffile.imread(self.whole / name)).all()
        assert log(out) == log(self.whole)
        ours, theirs = (json.loads((folder / "metrics.json").read_text()) for folder in (out, self.whole))
        assert ours.pop("seconds") >= 0
        assert theirs.pop("seconds") > 0
        assert ours == theirs

    def check_resumed(self, out: Path) -> Ended:
        """`--resume` ends as the run to which nothing happened."""
        ended = self.run(out, "--resume")
        assert ended.code == 0, ended.output
        self.check_as_whole(out)
        return ended


class Running:
    """A process with its children, in a session of its own."""

    def __init__(self, words: list[str], out: Path) -> None:
        self.out, self._began = out, time.monotonic()
        self.process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=ENV, start_new_session=True
        )

    @property
    def pid(self) -> int:
        return self.process.pid

    def kill(self) -> None:
        """kill −9, to the process and its children."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def wait_for(self, what: Callable[[], bool]) -> None:
        """Wait until something has happened in a run that goes on."""
        limit = time.monotonic() + 120
        while not what():
            assert self.process.poll() is None, self.process.communicate()[0]
            assert time.monotonic() < limit, "nothing happens"
            time.sleep(0.002)

    def let(self, seconds: float) -> None:
        """Let it run for so long, at most, from its start on."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(max(0, self._began + seconds - time.monotonic()))

    def wait_for_step(self, number: int) -> None:
        self.wait_for(lambda: len(log(self.out)) >= number)

    def wait_for_file(self, name: str) -> None:
        self.wait_for(lambda: (self.out / name).exists())

    def ended(self) -> Ended:
        output, _ = self.process.communicate(timeout=300)
        return Ended(self.process.returncode, said_in(output), time.monotonic() - self._began, output)


def said_in(output: str) -> list[str]:
    """The warnings and errors in what a run has printed."""
    return [found[1].strip() for line in re.split(r"[\r\n]", output) if (found := SAID.search(line))]


def log(out: Path) -> list[tuple[str, ...]]:
    """The whole rows of a log: step, misfit, loss."""
    path = out / "log.csv"
    if not path.exists():
        return []
    rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines(keepends=True)))
    return [tuple(row[:3]) for row in rows[1:] if len(row) == 4]


def saved(out: Path) -> int:
    """The step of a folder's checkpoint; 0 is none."""
    path = out / "checkpoint.pt"
    return torch.load(path, weights_only=True)["step"]["number"] if path.exists() else 0


def told(said: list[str]) -> str:
    """What was said, for a table: files without their folders, and short digests."""
    lines = [re.sub(r"\b([0-9a-f]{8})[0-9a-f]{56}\b", r"\1…", FOLDERS.sub("", line)) for line in said]
    return "; ".join(lines) or "nothing"
