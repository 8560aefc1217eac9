"""torchdic reconstruct: the refractive-index volume behind a stack of DIC images."""

import argparse
import signal
from typing import Any, NoReturn

from recon.config.reading import load
from recon.config.schema import ConfigError
from recon.run.reconstruct import reconstruct


def run(options: argparse.Namespace) -> None:
    """Fit a volume to the configuration's stack and print where it is and how well it explains the stack."""
    signal.signal(signal.SIGTERM, _interrupt)
    config = load(options.config)
    if config.data is None:
        raise ConfigError(f"{options.config}: missing key data.path: a reconstruction needs a stack")
    result = reconstruct(config, options.out, options.device, resume=options.resume, restart=options.restart)
    delta: Any = result.metrics["delta"]
    print(
        f"{options.out / 'volume.ome.tif'}: Δn {delta['min']:.4g} … {delta['max']:.4g}, "
        f"misfit {result.metrics['misfit']:.4g} after {result.metrics['steps']} steps"
    )


def _interrupt(_number: int, _frame: object) -> NoReturn:
    raise KeyboardInterrupt
