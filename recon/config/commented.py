"""A configuration file in TOML whose lines say where their values come from."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Origin = Literal["given", "file", "measured", "assumed"]


@dataclass(frozen=True)
class Sourced:
    """A value and where it comes from.

    value: as TOML holds it. origin: the user gave it, a file says it, the images show it, or nobody knows it.
    why: more of it in some words; "" is no more. name: in plain words, by which a value that is assumed is listed.
    """

    value: Any
    origin: Origin
    why: str = ""
    name: str = ""

    @property
    def comment(self) -> str:
        """The origin, and why."""
        return f"{self.origin}: {self.why}" if self.why else self.origin


@dataclass(frozen=True)
class Line:
    """A key, its value, and a comment; "" is none. A value that is a tuple of lines is an array, an element a line."""

    key: str
    value: Any
    comment: str = ""


def chosen(given: float | None, said: float | None, guess: float, name: str, why: str) -> Sourced:
    """What the user gave, else what a file says, else a guess.

    name: in plain words, of the quantity. why: the guess, in some words.
    """
    if given is not None:
        return Sourced(float(given), "given", name=name)
    if said is not None:
        return Sourced(float(f"{said:.6g}"), "file", name=name)
    return Sourced(guess, "assumed", why, name)


# What no comment of TOML can hold: control characters, and what stands for bytes of a name that isn't UTF-8.
_UNWRITABLE = re.compile(r"[\x00-\x08\x0a-\x1f\x7f\ud800-\udfff]")


def commented(head: Sequence[str], top: Sequence[Line], tables: Mapping[str, Sequence[Line]]) -> str:
    """A TOML text; what no comment can hold is a question mark in it.

    head: lines of comment at its beginning. top: keys before the first table. tables: the lines of each table.
    """
    lines = [f"# {_UNWRITABLE.sub('?', line)}".rstrip() for line in head]
    if top:
        lines += ["", *_lines(top)]
    for name, below in tables.items():
        lines += ["", f"[{name}]", *_lines(below)]
    return "\n".join(lines) + "\n"


def comments_of(text: str) -> dict[str, str]:
    """The comments behind the values of a TOML text, by their keys, such as volume.shape.

    Of an array whose elements stand in lines of their own, an element's comment has its number: acquisition.prisms[0].
    Comments in lines of their own belong to no key, nor do those of tables in an array.
    """
    found: dict[str, str] = {}
    table, array, number = "", "", 0
    for line in text.splitlines():
        code, comment = _split(line)
        key = ""
        if array:
            if code.startswith("]"):
                array = ""
            elif code:
                key, number = f"{array}[{number}]", number + 1
        elif code.startswith("["):
            table = code.strip("[] ") + "."
        elif named := re.match(r"([\w.-]+)\s*=\s*(.*)", code):
            key = f"{table}{named[1]}"
            array, number = (key, 0) if named[2] == "[" else ("", 0)
        if key and comment:
            found[key] = comment
    return found


def _split(line: str) -> tuple[str, str]:
    """The code and the comment of a line; a # within quotes begins none."""
    quote, escaped = "", False
    for place, sign in enumerate(line):
        if quote:
            quote = "" if sign == quote and not escaped else quote
            escaped = sign == "\\" and quote == '"' and not escaped
        elif sign in "'\"":
            quote = sign
        elif sign == "#":
            return line[:place].strip(), line[place + 1 :].strip()
    return line.strip(), ""


def inline(value: Any) -> str:
    """A value of TOML in one line. Raises TypeError for what TOML can't hold."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case int():
            return str(value)
        case float() if not math.isnan(value):
            return repr(value)
        case list() | tuple():
            return f"[{', '.join(map(inline, value))}]"
        case dict():
            return f"{{ {', '.join(f'{key} = {inline(below)}' for key, below in value.items())} }}"
    raise TypeError(f"{value!r} is no value of TOML")


def _lines(below: Sequence[Line]) -> list[str]:
    written = []
    for line in below:
        if isinstance(line.value, tuple) and line.value and isinstance(line.value[0], Line):
            written.append(_with(f"{line.key} = [", line.comment))
            written += [_with(f"    {inline(each.value)},", each.comment) for each in line.value]
            written.append("]")
        else:
            written.append(_with(f"{line.key} = {inline(line.value)}", line.comment))
    return written


def _with(text: str, comment: str) -> str:
    return f"{text:<40} # {_UNWRITABLE.sub('?', comment)}" if comment else text
