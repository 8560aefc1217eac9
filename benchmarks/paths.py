"""Two people's paths by the commands of the pages alone, each from an empty folder, and the time that each step takes.

    python benchmarks/paths.py [--out paths]

The first has a stack (docs/own_stack.md) and wants a report to send; the second wants a loss of her own
(docs/howto/own_loss.md) and a fit that runs. What runs is the text of the pages' blocks. Seconds are the clock's and,
in brackets, the processor's, of all processes. The commands must be on the path, as in an environment that is entered.
"""

import argparse
import re
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def main() -> None:
    """Print a row for each step. Raises CalledProcessError where a command of a page fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("paths"), help="folder for the two, which must not exist")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True)
    print("| path | step | s | (processor) |\n|---|---|---|---|")
    for path, steps in (("I have a stack", own_stack()), ("a loss of my own", own_loss())):
        folder = out / path.replace(" ", "_")
        folder.mkdir()
        for shown, command in steps:
            spent, clock = _children(), time.perf_counter()
            with (folder / "said.txt").open("a", encoding="utf-8") as said:
                subprocess.run(command, cwd=folder, check=True, stdout=said, stderr=said)
            print(
                f"| {path} | `{shown}` | {time.perf_counter() - clock:.0f} | ({_children() - spent:.0f}) |", flush=True
            )
    report = out / "I_have_a_stack" / "volume" / "report.html"
    print(f"\n{report}: {report.stat().st_size / 1e6:.1f} MB")


def own_stack() -> Iterator[tuple[str, list[str]]]:
    """The commands from a stack to its report: those at the page's head, with what is known told at once."""
    first, *others = blocks("sh", DOCS / "own_stack.md")
    (known,) = (line for block in others for line in block.splitlines() if line.startswith("torchdic new"))
    for line in first.splitlines():
        words = shlex.split(line, comments=True)
        if words[:2] == ["torchdic", "new"]:
            words = shlex.split(known, comments=True)
        if words:
            script = words[0] == "python"
            yield shlex.join(words), [sys.executable, str(ROOT / words[1]), *words[2:]] if script else words


def own_loss() -> Iterator[tuple[str, list[str]]]:
    """The page's program."""
    yield "python own_loss.py", [sys.executable, "-c", "".join(blocks("python", DOCS / "howto" / "own_loss.md"))]


def blocks(language: str, page: Path) -> list[str]:
    """The blocks of code on a page."""
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def _children() -> float:
    """Processor seconds of all processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
