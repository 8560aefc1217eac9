"""The files that `torchdic new` writes: that they can be written, and that none is overwritten."""

from collections.abc import Sequence
from pathlib import Path

from recon.config.schema import ConfigError
from recon.run.folder.prepared import check_folder


def joined_beside(out: Path) -> Path:
    """The stack that is joined of several files, beside its configuration."""
    return out.with_name(f"{out.stem}.stack.ome.tif")


def check_out(out: Path, stacks: Sequence[Path]) -> None:
    """Raise ConfigError where a configuration can't be written, or would overwrite a file: all of them in one line.

    stacks: the files and folders that the user names; of several files a stack is joined.
    """
    if out.suffix.lower() != ".toml":
        raise ConfigError(f"--out {out}: the configuration's name must end in .toml")
    check_folder(out.parent)
    joined, several = joined_beside(out), len(stacks) > 1
    # a folder may hold one file, of which no stack is joined
    if out.exists() or several:
        may_be_joined = several or any(stack.is_dir() for stack in stacks)
        check_not_there([out, joined] if may_be_joined else [out])


def check_not_there(files: Sequence[Path]) -> None:
    """Raise ConfigError where files are there already, which names them all."""
    there = [file for file in files if file.exists()]
    if not there:
        return
    if len(there) == 1:
        raise ConfigError(f"{there[0]}: is there already, and isn't overwritten; choose another name or remove it")
    named = " and ".join(map(str, there))
    raise ConfigError(f"{named}: are there already, and aren't overwritten; choose another name or remove them")
