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
    """The values of a TOML file. Raises ValueError where it is none; a decimal comma is said to be one."""
    text = ""
    try:
        text = decoded(content)
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError is one
        comma = _COMMA.search(text)
        if comma is None:
            raise ValueError(f"is not TOML: {error}") from error
        line, number = text.count("\n", 0, comma.start(1)) + 1, comma[1]
        point = number.replace(",", ".")
        raise ValueError(f"is not TOML: {number} in line {line} has a decimal comma: write {point}") from error


def _undecodable(error: UnicodeDecodeError, content: bytes, encoding: str | None) -> str:
    if encoding is not None:
        return f"its byte-order mark says {error.encoding.upper()}, which it is not: {error.reason}"
    line = content.count(b"\n", 0, error.start) + 1
    byte = content[error.start : error.start + 1]
    guess = byte.decode("cp1252", "replace")
    read = "" if guess == "\ufffd" else f" (it is {guess!r} in Windows-1252)"
    return f"'utf-8' codec can't decode byte 0x{byte.hex()} in line {line}{read}"
