"""Output that any terminal can show, and that no run fails of: what its encoding lacks is written in plain letters."""

import codecs
import errno
import os
import sys
from typing import Any, TextIO, cast

# What stands for the signs of messages where the terminal hasn't got them.
_SIGNS = "µ=u μ=u Δ=d ×=x ·=* …=... −=- –=- ±=+- ≤=<= ≥=>= °=deg ²=^2 ³=^3 π=pi λ=lambda σ=sigma θ=theta ∞=inf √=sqrt"
_PLAIN = {sign: letters for sign, _, letters in (pair.partition("=") for pair in _SIGNS.split())}

_HANDLER = "torchdic.plain"


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


class Unfailing:
    """An output stream that a run outlives: what it can't take is lost, as where `head` has read enough.

    lost: why what is written is lost; None where it isn't.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.lost: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or lose what can't be written."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._lose(error)
            return len(text)

    def flush(self) -> None:
        """Write what is held back, or lose it."""
        try:
            self._stream.flush()
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Let this and all that follows go nowhere, without a further error, and say so unless nobody reads it."""
        self.lost = error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        if error.errno != errno.EPIPE and self._stream is sys.__stdout__:
            print(f"torchdic: error: what is printed is lost: {error.strerror}", file=sys.stderr)


def write_plainly() -> None:
    """Let stdout and stderr write what their encoding lacks in plain letters, and let nothing fail of them.

    So no message is ever lost that can be shown, and no run for a message that can't.
    """
    codecs.register_error(_HANDLER, _in_plain_letters)
    for stream in (sys.stdout, sys.stderr):
        # a stream that a program has put in the terminal's place may be of another kind, or absent
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors=_HANDLER)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and stream is getattr(sys, f"__{name}__"):
            setattr(sys, name, cast(TextIO, Unfailing(stream)))


def all_said() -> bool:
    """Whether all that was printed has reached what stands for the terminal, or nobody wants to read it."""
    if isinstance(sys.stdout, Unfailing):
        sys.stdout.flush()
        return sys.stdout.lost is None or sys.stdout.lost.errno == errno.EPIPE
    return True
