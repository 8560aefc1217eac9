"""torchdic doctor: what an installation holds, and whether it computes what it should."""

import argparse
import time
from pathlib import Path

from recon.cli.doctor.installation import lines
from recon.cli.doctor.selftest import SelfTestError, outcomes


def run(options: argparse.Namespace) -> None:
    """Print what there is, and the outcome of the self-test. Raises SelfTestError where a part of it fails."""
    for name, words in lines(options.device, Path()):
        print(f"{name:14}{words}")
    began, failed = time.perf_counter(), []
    for outcome in outcomes(options.device):
        print(f"{'self-test':14}{outcome.what}: {outcome.error:.1e}, {'passed' if outcome.passed else 'FAILED'}")
        failed += [] if outcome.passed else [f"{outcome.what} ({outcome.error:.1e}, at most {outcome.limit:.1e})"]
    if failed:
        raise SelfTestError(f"this installation computes something else than it should: {'; '.join(failed)}")
    print(f"{'':14}in {time.perf_counter() - began:.1f} s on {options.device}")
