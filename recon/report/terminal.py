"""Output that any terminal can show: what its encoding lacks is written in plain letters instead."""

import codecs
import sys

# What stands for the signs of messages where the terminal hasn't got them.
_SIGNS = "µ=u μ=u Δ=d ×=x ·=* …=... −=- –=- ±=+- ≤=<= ≥=>= °=deg ²=^2 ³=^3 π=pi λ=lambda σ=sigma θ=theta ∞=inf √=sqrt"
_PLAIN = {sign: letters for sign, _, letters in (pair.partition("=") for pair in _SIGNS.split())}

_HANDLER = "torchdic.plain"


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


def write_plainly() -> None:
    """Let stdout and stderr write what their encoding lacks in plain letters, so that no message is ever lost."""
    codecs.register_error(_HANDLER, _in_plain_letters)
    for stream in (sys.stdout, sys.stderr):
        # a stream that a program has put in the terminal's place may be of another kind, or absent
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors=_HANDLER)
