"""torchdic reconstruct: the refractive-index volume behind a stack of DIC images."""

import argparse
import signal
import warnings
from typing import Any, NoReturn

from recon.config.reading import load
from recon.config.schema import AssumedWarning, ConfigError
from recon.run.reconstruct import reconstruct
from torchdic.ranks.shared import check_ranks


def run(options: argparse.Namespace) -> None:
    """Fit a volume to the configuration's stack and print where it is and how well it explains the stack."""
    signal.signal(signal.SIGTERM, _interrupt)
    config = load(options.config)
    if config.data is None:
        raise ConfigError(f"{options.config}: missing key data.path: a reconstruction needs a stack")
    if config.assumed:
        warnings.warn(
            f"{options.config}: assumed, not known: {', '.join(config.assumed)}; the volume is as wrong as they are. "
            "Correct them, and take their names out of `assumed`",
            AssumedWarning,
            stacklevel=2,
        )
    result = reconstruct(config, options.out, options.device, resume=options.resume, restart=options.restart)
    delta: Any = result.metrics["delta"]
    print(
        f"{options.out / 'volume.ome.tif'}: Δn {delta['min']:.4g} … {delta['max']:.4g}, "
        f"misfit {result.metrics['misfit']:.4g} after {result.metrics['steps']} steps"
    )


def _interrupt(_number: int, _frame: object) -> NoReturn:
    check_ranks()  # torchrun sends SIGTERM where one has ended
    raise KeyboardInterrupt
