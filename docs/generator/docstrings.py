"""The house's docstrings, read: a text, `name: meaning` for each argument or field, and `Raises …`.

An argument's meaning begins with its name, or several names with commas between them, and a colon, at the start of a
line or of a sentence. It ends with the next name, an empty line, or a sentence that begins on a line of its own, unless
that line is indented.
"""

import inspect
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import pairwise

# What docutils would take for markup.
_MARKUP = re.compile(r"([\\*|_])")


@dataclass(frozen=True)
class Read:
    """A docstring in its parts.

    text: its paragraphs in their order, those of the arguments left out. meanings: of each name that it explains.
    """

    text: list[str] = field(default_factory=list)
    meanings: dict[str, str] = field(default_factory=dict)


def read(docstring: str | None, names: Collection[str]) -> Read:
    """The parts of a docstring.

    docstring: as Python holds it, or None. names: what it may explain; another word before a colon is text.
    """
    found = Read()
    without_headings = re.sub(r"^[A-Z]\w+\n-+\n", "", inspect.cleandoc(docstring or ""), flags=re.MULTILINE)
    for chunk, indented in _chunks(without_headings, names):
        named = _beginning(names).match(chunk)
        if indented or not named:
            found.text.append(f"    {chunk}" if indented else chunk)
            continue
        for name in named[1].split(", "):
            found.meanings[name] = chunk[named.end() :].strip()
    return found


def _beginning(names: Collection[str]) -> re.Pattern[str]:
    one = "|".join(sorted(map(re.escape, names), key=len, reverse=True)) or "(?!)"
    return re.compile(rf"((?:{one})(?:, (?:{one}))*):(?:\s|$)")


def _chunks(docstring: str, names: Collection[str]) -> list[tuple[str, bool]]:
    """Paragraphs, meanings and sentences on lines of their own, each in one line, and whether it is an equation."""
    begins, chunks = _beginning(names), []
    inner = re.compile(rf"(?<=[.;])\s+(?={begins.pattern})")
    for paragraph in re.split(r"\n\s*\n", docstring):
        open_chunk: list[str] = []
        for line in paragraph.split("\n"):
            ended = bool(open_chunk) and open_chunk[-1].endswith((".", ":"))
            apart = not line.startswith(" ") and ended and line[:1].isupper()
            of_names = bool(open_chunk) and bool(begins.match(open_chunk[0]))
            if open_chunk and (begins.match(line) or (apart and of_names)):
                chunks.append((" ".join(open_chunk), False))
                open_chunk = []
            if line.startswith("    ") and not of_names:
                if open_chunk:
                    chunks.append((" ".join(open_chunk), False))
                    open_chunk = []
                chunks.append((line.strip(), True))
            elif line.strip():
                open_chunk.append(line.strip())
        if open_chunk:
            chunks.append((" ".join(open_chunk), False))
    return [(part.strip(), equation) for chunk, equation in chunks for part in _parts(chunk, equation, inner)]


def _parts(chunk: str, equation: bool, inner: re.Pattern[str]) -> list[str]:
    """A chunk, divided before each name that begins a sentence."""
    if equation:
        return [chunk]
    cuts = [0, *(match.end() for match in inner.finditer(chunk)), len(chunk)]
    return [chunk[a:b] for a, b in pairwise(cuts)]


def raised(docstring: str | None) -> str:
    """What a docstring says of its errors: the sentences from `Raises` on, in one line; empty where it says nothing."""
    found = re.search(
        r"(?<!\w)Raises .*?\.(?=\s*\n\s*\n|\s*$|\s+Warns|\s+[A-Z]\w+ (?:is|are|holds) )", docstring or "", re.DOTALL
    )
    return " ".join(found[0].split()) if found else ""


def as_rst(text: str) -> str:
    """A line of a docstring as reStructuredText: what stands in backticks is code, all else is no markup."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return _MARKUP.sub(r"\\\1", text).replace("`", "\\`")
    return "".join(
        f":py:obj:`{part}`\\ " if i % 2 and re.fullmatch(r"[A-Za-z_][\w.]*", part)
        else f"``{part}``\\ " if i % 2
        else _MARKUP.sub(r"\\\1", part)
        for i, part in enumerate(parts)
    )  # fmt: skip


def restructured(docstring: str, names: Collection[str]) -> list[str]:
    """The lines of a docstring as reStructuredText: equations as literal blocks, arguments as a list of fields."""
    found, lines, equation = read(docstring, names), [], False
    for chunk in found.text:
        if chunk.startswith("    "):
            lines += [chunk] if equation else ["::", "", chunk]
        else:
            lines += ["", as_rst(chunk), ""] if equation else [as_rst(chunk), ""]
        equation = chunk.startswith("    ")
    lines.append("")
    lines += [f":param {name}: {as_rst(meaning)}" for name, meaning in found.meanings.items()]
    return [*lines, ""]
