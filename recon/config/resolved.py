"""config.resolved.toml: what a command has run with, left beside its results."""

from pathlib import Path

from recon.config.conversion import dump
from recon.config.schema import Config
from torchdic.files.whole import write_text

RESOLVED = "config.resolved.toml"


def leave_resolved(config: Config, out: Path, *notes: str, name: str = RESOLVED) -> None:
    """Write a configuration with every key and its value into a folder. Raises WriteError.

    notes: lines that stand above it as comments. name: the file's.
    """
    write_text(out / name, "".join(f"# {note}\n" for note in notes) + dump(config))
