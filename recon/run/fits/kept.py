"""Trials of fits on disk: each is kept as it comes, so that an interruption loses nothing."""

import hashlib
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from recon.config.conversion import flat
from recon.config.schema import CoverageSection, SimulationSection, WorkPrecisionSection
from recon.report.fit_fronts import write_fits
from recon.report.fit_trial import FitCandidate, FitTrial
from recon.run.checkpoint import CheckpointError
from recon.run.fits.trials import Recorded
from recon.run.folder.results import check_no_results
from torchdic.files.whole import write_json

FITS = "fits.json"


@dataclass(frozen=True)
class EarlierTrials:
    """Trials that an earlier run has left. path: of their file. identity: of the configuration and the stack."""

    path: Path
    identity: str
    trials: tuple[FitTrial, ...]

    @classmethod
    def within(cls, out: Path, *, resume: bool, restart: bool) -> "EarlierTrials | None":
        """What an earlier run has left in a folder to go on from; None where there is nothing, or it is to be replaced.

        Raises CheckpointError where the user must choose between both or the file can't be read, and FinishedError
        where it holds all trials of a finished run.
        """
        path = out / FITS
        if restart or not path.exists():
            return None
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            complete, identity = bool(content["complete"]), str(content["identity"])
            trials = [FitTrial(**{**row, "candidate": FitCandidate(**row["candidate"])}) for row in content["trials"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{path}: holds no trials of this version: {error}; --restart replaces it") from error
        if not resume:
            if complete:
                check_no_results(out, (FITS,), restart=False)
            raise CheckpointError(
                f"{path}: {len(trials)} fits of an interrupted run; go on with --resume or begin anew with --restart"
            )
        return cls(path, identity, tuple(trials))


class KeptTrials:
    """The trials of one stack in a folder: fits.json and fits.csv, written anew after each.

    trials: those so far, in the order in which they were done.
    """

    def __init__(self, out: Path, recorded: Recorded, earlier: EarlierTrials | None = None) -> None:
        """Go on from earlier trials. Raises CheckpointError where they are another stack's or configuration's."""
        self.out, self.identity = out, _identity(recorded)
        if earlier is not None and earlier.identity != self.identity:
            raise CheckpointError(
                f"{earlier.path}: holds fits of another configuration or stack; begin anew with --restart"
            )
        self.trials = [] if earlier is None else list(earlier.trials)

    def missing(self, candidates: Sequence[FitCandidate]) -> list[FitCandidate]:
        """The candidates that haven't been tried."""
        done = {trial.candidate for trial in self.trials}
        return [candidate for candidate in candidates if candidate not in done]

    def add(self, trial: FitTrial, *, complete: bool) -> None:
        """Keep a trial. complete: whether it is the last one."""
        self.trials.append(trial)
        self.write(complete=complete)

    def write(self, *, complete: bool) -> None:
        """Write fits.csv, and fits.json with the machine on which the fits ran."""
        write_fits(self.out / "fits.csv", self.trials)
        content = {
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
            "machine": platform.machine(),
            "identity": self.identity,
            "complete": complete,
            "trials": [asdict(trial) for trial in self.trials],
        }
        write_json(self.out / FITS, content)


def _identity(recorded: Recorded) -> str:
    """A digest of all that the trials depend on: the configuration but for its candidates, and the stack."""
    config = replace(
        recorded.config,
        data=None,  # what is fitted of them is in the digest
        specimen=None,
        coverage=CoverageSection(),
        simulation=SimulationSection(),
        work_precision=WorkPrecisionSection(),
        candidates=None,
    )
    digest = hashlib.sha256("\n".join(flat(config)).encode())
    digest.update(recorded.measured.data.tobytes())
    if recorded.truth is not None:
        digest.update(recorded.truth.numpy().tobytes())
    return digest.hexdigest()
