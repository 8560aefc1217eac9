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

from recon.run.tiles.kept import TILES
from torchdic.files.whole import PARTIAL

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
    config: the configuration. tiled: whether it asks for tiles. tolerance: how much of the largest value the results of
    two runs may differ by.
    """

    start: tuple[str, ...] = (sys.executable,)
    options: tuple[str, ...] = ()
    config: str = CONFIG
    tiled: bool = False
    tolerance: float = 0.0

    @property
    def results(self) -> set[str]:
        """The files that a run leaves."""
        return RESULTS - {"log.csv", "checkpoint.pt"} if self.tiled else RESULTS

    def fits(self, out: Path) -> list[Path]:
        """The folders of a run's logs and checkpoints."""
        return sorted(path for path in out.glob("tiles/*") if path.is_dir()) if self.tiled else [out]


# Two tiles, which overlap.
TILED = (
    CONFIG.replace("shape = [8, 48, 44]", "shape = [8, 34, 48]")
    .replace("sources = 72", "sources = 24")
    .replace("[reconstruction]", "[reconstruction]\ntiles = 36")
)
# Ranks round each sum of theirs (docs/ranks.md).
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")

# Kills befall each of them, and what else can end in another way than by one process.
LAUNCHES = {
    "one process": Launch(),
    "tiles": Launch(config=TILED, tiled=True),
    "torchrun": Launch(start=TORCHRUN, tolerance=1e-4),
}


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

    def check_as_whole(self, out: Path, killed: bool = False) -> None:
        """What is in a folder is what the run to which nothing happened has left.

        killed: whether it was, at its end, and may have left its tiles half removed, for the next run in the folder.
        """
        names = {path.name for path in out.iterdir()} - {".lock"}
        if killed:
            names.discard(f"{PARTIAL}{TILES}")
        assert names == self.launch.results
        for name in ("volume.ome.tif", "images.ome.tif"):
            ours, theirs = (tifffile.imread(folder / name) for folder in (out, self.whole))
            assert abs(ours - theirs).max() <= self.launch.tolerance * abs(theirs).max()
        assert len(log(out)) == len(log(self.whole))
        if self.launch.tolerance > 0:  # rounding changes the last digits of all that follows from it
            return
        assert log(out) == log(self.whole)
        ours, theirs = (json.loads((folder / "metrics.json").read_text()) for folder in (out, self.whole))
        for found in (ours, theirs):
            assert found.pop("seconds") >= 0
            found.get("tiles", {}).pop("seconds", None)
        assert ours == theirs

    def is_finished(self, out: Path) -> bool:
        """Whether a run has nothing left to go on from: its tiles go last, and it keeps no checkpoint."""
        return self.launch.tiled and (out / "metrics.json").exists() and not (out / "tiles").exists()

    def steps(self) -> int:
        """The steps of the run to which nothing happened."""
        tiles = json.loads((self.whole / "metrics.json").read_text()).get("tiles")
        return len(log(self.whole)) if tiles is None else sum(tiles["steps"].values())

    def taken(self, out: Path) -> int:
        """The steps in the logs of a run."""
        return sum(len(log(folder)) for folder in self.launch.fits(out))

    def saved(self, out: Path) -> int:
        """The steps that a run would go on from."""
        return sum(saved(folder, "fitted.pt") or saved(folder) for folder in self.launch.fits(out))

    def check_resumed(self, out: Path) -> Ended:
        """`--resume` ends as the run to which nothing happened."""
        assert not self.is_finished(out)
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
        """kill −9, to the process and all that it has started."""
        for pid in (self.process.pid, *started_by(self.process.pid)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def kill_rank(self, rank: int) -> bool:
        """kill −9, to one rank of a run under torchrun; returns whether there is one by now."""
        for pid in started_by(self.process.pid):
            with suppress(OSError):  # it has ended
                if f"RANK={rank}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                    os.kill(pid, signal.SIGKILL)
                    return True
        return False

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


def started_by(pid: int) -> list[int]:
    """The processes that a process has started, and that these have; none where the system has no /proc."""
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the process has ended
            found += map(int, path.read_text().split())
    return [*found, *(later for child in found for later in started_by(child))]


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


def saved(out: Path, name: str = "checkpoint.pt") -> int:
    """The step of a folder's checkpoint; 0 is none."""
    path = out / name
    return torch.load(path, weights_only=True)["step"]["number"] if path.exists() else 0


def told(said: list[str]) -> str:
    """What was said, for a table: files without their folders, and short digests."""
    lines = [re.sub(r"\b([0-9a-f]{8})[0-9a-f]{56}\b", r"\1…", FOLDERS.sub("", line)) for line in said]
    return "; ".join(lines) or "nothing"
