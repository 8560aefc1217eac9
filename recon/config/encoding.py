"""The text of a configuration file, in whatever encoding its editor saved it."""

import codecs
import re
import tomllib
from typing import Any

# Byte-order marks, longest first: UTF-32's begins with UTF-16's.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)

# A number with a decimal comma, in no array: the next key of a table may follow it.
_COMMA = re.compile(r"^[^#\n]*=\s*([+-]?\d+,\d+)\s*[,#}\n]", re.MULTILINE)

# Where tomllib says that it stopped, and the quotation marks that word processors put in place of " and '.
_PLACE, _QUOTES = re.compile(r"\(at line (\d+), column \d+\)$"), "“”„‟«»‘’‚"


def decoded(content: bytes) -> str:
    """The text of a file: UTF-8, or what its byte-order mark says.

    Raises ValueError where it is neither; the message says what it may be, and how to save it.
    """
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), None)
    try:
        text = content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{_undecodable(error, content, encoding)}; save the file as UTF-8") from error
    if encoding is None and "\0" in text:
        raise ValueError("it seems to be UTF-16 or UTF-32 without a byte-order mark; save the file as UTF-8")
    return text


def values_in(content: bytes) -> dict[str, Any]:
    """The values of a TOML file. Raises ValueError where it is none, with what is usually wrong with such a line."""
    text = ""
    try:
        text = decoded(content)
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError is one
        raise ValueError(f"is not TOML: {_usual_mistake(text, str(error)) or error}") from error


def _usual_mistake(text: str, error: str) -> str | None:
    """What is wrong with a text that is no TOML, in words, where it is one of the usual mistakes; else None."""
    if (comma := _COMMA.search(text)) is not None:
        line, number = text.count("\n", 0, comma.start(1)) + 1, comma[1]
        return f"{number} in line {line} has a decimal comma: write {number.replace(',', '.')}"
    if (place := _PLACE.search(error)) is None:
        return None
    number = int(place[1])
    line = text.split("\n")[number - 1].strip()
    if (quote := next((sign for sign in _QUOTES if sign in line.partition("#")[0]), None)) is not None:
        return f'line {number} has the quotation mark {quote}: write "'
    if error.startswith(("Unescaped '\\'", "Invalid hex value")):
        return f"line {number} has a single \\ in double quotes: write / between folders, or '…' in place of \"…\""
    if error.startswith("Cannot overwrite"):
        return f"line {number} says again what was said before: {line}"
    return None


def _undecodable(error: UnicodeDecodeError, content: bytes, encoding: str | None) -> str:
    if encoding is not None:
        return f"its byte-order mark says {error.encoding.upper()}, which it is not: {error.reason}"
    line = content.count(b"\n", 0, error.start) + 1
    byte = content[error.start : error.start + 1]
    guess = byte.decode("cp1252", "replace")
    read = "" if guess == "\ufffd" else f" (it is {guess!r} in Windows-1252)"
    return f"'utf-8' codec can't decode byte 0x{byte.hex()} in line {line}{read}"
