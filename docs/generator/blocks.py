"""The blocks of code on the pages are checked: what can be run in seconds is run, the rest is read.

Python runs, all blocks of a page in one namespace. TOML is parsed. Of a shell's lines `torchdic …` is read by the
command's parser, `make …` must be a target, `python …` a file, and `torchdic[…]` an extra. A block in which "…" stands
for something that is left out is no code, and Python in which "..." does is compiled alone.
"""

import contextlib
import os
import re
import shlex
import tempfile
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path

from generator import commands
from recon.cli import arguments
from recon.cli.commands import COMMANDS

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "howto").glob("*.md")))


class BlockError(ValueError):
    """A block of code on a page doesn't work."""


def check_all(*_: object) -> None:
    """Check the blocks of all pages. Raises BlockError with the page and the line that can't be used."""
    for page in PAGES:
        check(page)
        run_python(page)


def check(page: Path) -> None:
    """Read the blocks of a page without running any. Raises BlockError as `check_all` does."""
    for language, block in blocks(page):
        if "…" in block and language != "sh":
            continue
        try:
            READERS.get(language, len)(block)
        except (ValueError, SyntaxError) as error:
            raise BlockError(f"{page.name}: a block of {language}: {error}") from error


def run_python(page: Path) -> None:
    """Run the Python of a page in a folder of its own. Raises what it raises."""
    whole = [block for language, block in blocks(page) if language == "python" and "..." not in block]
    program = "\n".join(whole)
    if not program:
        return
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(None), warnings.catch_warnings():
        warnings.simplefilter("error")
        os.chdir(folder)
        try:
            exec(compile(program, str(page), "exec"), {"__name__": "page"})
        finally:
            os.chdir(before)


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """The language and the text of each block of a page."""
    yield from re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def _shell(block: str) -> None:
    """Raise ValueError for a line that can't be what is meant."""
    for line in block.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["torchdic"] and words[1:2] != ["--help"]:
            _command(words[1], words[2:])
        if words[:1] == ["make"] and not re.search(
            rf"^{re.escape(words[1])}( [\w-]+)*:", _text("Makefile"), re.MULTILINE
        ):
            raise ValueError(f"{line}: the Makefile has no such target")
        if words[:1] == ["python"] and words[1].endswith(".py") and not (ROOT / words[1]).exists():
            raise ValueError(f"{line}: there is no such file")
        for extra in re.findall(r"(?:torchdic|\.)\[([\w,]+)\]", line):
            if not {*extra.split(",")} <= {*tomllib.loads(_text("pyproject.toml"))["project"]["optional-dependencies"]}:
                raise ValueError(f"{line}: there is no extra {extra}")


def _text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _command(name: str, words: list[str]) -> None:
    if name not in COMMANDS:
        raise ValueError(f"torchdic {name}: there is no such command")
    parser = commands.parser(name, COMMANDS[name])
    said: list[str] = []
    parser.error = said.append  # pyright: ignore[reportAttributeAccessIssue]
    parser.parse_args(arguments.repeated(words, COMMANDS[name].several))
    if said:
        raise ValueError(f"torchdic {shlex.join([name, *words])}: {said[0]}")


READERS = {"sh": _shell, "toml": tomllib.loads, "python": lambda block: compile(block, "page", "exec")}
