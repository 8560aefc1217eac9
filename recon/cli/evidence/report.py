"""torchdic report: report.html of a folder of results, made again from the files that are there."""

import argparse
from pathlib import Path

from recon.config.schema import ConfigError
from recon.report.html.page import leave_report
from recon.run.folder.prepared import prepare_folder


def arguments(parser: argparse.ArgumentParser) -> None:
    """The folder of the results."""
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of results; the page goes there too")


def run(options: argparse.Namespace) -> None:
    """Make the page, and print where it is and how large."""
    folder = options.folder
    if not folder.is_dir():
        raise ConfigError(f"{folder}: {'is no folder' if folder.exists() else 'there is no such folder'}")
    prepare_folder(folder)
    path = leave_report(folder)
    if path is None:
        raise ConfigError(f"{folder}: holds no results of torchdic to report")
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
