"""The refits of a volume in its folder: each is kept as soon as it is done, and serves again."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon.evidence.refits import Kind, Named, Refit
from recon.run.checkpoint import CheckpointError
from torchdic.files.whole import write_text, written_whole

FOLDER, IDENTITY = "refits", "identity.txt"

# The numbers that refits tell.
ERROR_BARS = "error_bars.json"


@dataclass(frozen=True)
class KeptRefits:
    """A folder with the volumes of refits, (z, y, x) as .npy. identity: of the estimate and its data, in one line."""

    folder: Path
    identity: str

    def begin(self, *, restart: bool) -> None:
        """Make the folder, and make sure that its refits are this estimate's.

        restart: throw those of another one away. Raises CheckpointError where they are another one's.
        """
        told = self.folder / IDENTITY
        if restart and self.folder.exists():
            shutil.rmtree(self.folder)
        self.folder.mkdir(exist_ok=True)
        if not any(self.folder.iterdir()):
            write_text(told, self.identity)
        elif not told.exists() or told.read_text(encoding="utf-8") != self.identity:
            raise CheckpointError(f"{self.folder}: holds the refits of another volume; replace them with --restart")

    def missing(self, wanted: list[Named]) -> list[Named]:
        """Those that have yet to be done."""
        return [(kind, number) for kind, number in wanted if not self._file(kind, number).exists()]

    def keep(self, refit: Refit) -> None:
        """Keep the volume that a refit found. Raises WriteError."""
        with written_whole(self._file(refit.kind, refit.number)) as partial, partial.open("wb") as file:
            np.save(file, refit.delta.numpy())

    def delta(self, kind: Kind, number: int) -> Tensor:
        """The volume that a refit found."""
        return torch.from_numpy(np.load(self._file(kind, number)))

    def _file(self, kind: str, number: int) -> Path:
        return self.folder / f"{kind}_{number:02d}.npy"
