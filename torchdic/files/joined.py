"""One stack from several files, or from a file's channels in another order."""

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack, shape_text
from torchdic.files.stack import read_stack

# Sizes that differ by a larger part of them aren't those of one recording.
_TOLERANCE = 0.01


def read_joined(paths: Sequence[str], channels: Sequence[int] | None = None, series: int | None = None) -> Stack:
    """The stack whose prisms are the channels of files.

    paths: of the files, each as `read_stack` takes it. A file that is named more than once is read once.
    channels: None takes all channels of one file after the other. For one file, the channels that are the prisms, in
        their order; for several, the channel of each. They are counted from 0.
    series: of each file, as in `read_stack`.

    Raises StackError as `read_stack` does, for a channel that a file doesn't have, and where files differ in their
    planes, pixels, dtype or full scale. Warns StackWarning where they differ in the size of a pixel or in the focus
    step: the first file's are used.
    """
    files = {path: read_stack(path, series) for path in dict.fromkeys(paths)}
    if channels is None:
        chosen = [(path, channel) for path in paths for channel in range(len(files[path].data))]
    else:
        named = list(paths) * len(channels) if len(paths) == 1 else list(paths)
        chosen = list(zip(named, channels, strict=True))
    for path, channel in chosen:
        held = len(files[path].data)
        if not (0 <= channel < held):
            found = "one channel" if held == 1 else f"{held} channels"
            raise StackError(f"{path}: has {found}, counted from 0; there is no channel {channel}")
    stacks = list(files.values())
    check_alike(stacks)
    first = stacks[0]
    if len(stacks) == 1 and chosen == [(paths[0], channel) for channel in range(len(first.data))]:
        return first
    names = tuple(files[path].names[channel] for path, channel in chosen if files[path].names)
    return Stack(
        np.stack([files[path].data[channel] for path, channel in chosen]),
        pixel_size=_agreed(stacks, "pixel_size"),
        focus_step=_agreed(stacks, "focus_step"),
        bits=max((stack.bits for stack in stacks if stack.bits is not None), default=None),
        names=names if len(names) == len(chosen) else (),
        source=", ".join(files),
        full_scale=first.full_scale,
    )


def check_alike(stacks: Sequence[Stack], *, settings: bool = False) -> None:
    """Raise StackError where files can't be parts of one stack. settings: whether each must hold as many of them."""
    first, shape = stacks[0], "settings × planes × pixels (y × x)" if settings else "planes × pixels (y × x)"
    for other in stacks[1:]:
        for what, of in (
            (shape, lambda stack: shape_text(stack.data.shape[0 if settings else 1 :])),
            ("pixels of type", lambda stack: stack.data.dtype.name),
            ("full scale", lambda stack: stack.full_scale),
        ):
            if of(first) != of(other):
                raise StackError(
                    f"{other.source}: {what} {of(other)}, but {first.source} has {of(first)}: "
                    "the files of one stack have the same"
                )


def _agreed(stacks: Iterable[Stack], name: str) -> Any:
    """A size of the first file that says it; warns where another says otherwise."""
    known = [(stack.source, value) for stack in stacks if (value := getattr(stack, name)) is not None]
    if not known:
        return None
    (source, first), *others = known
    for other, value in others:
        if not np.allclose(first, value, rtol=_TOLERANCE):
            warnings.warn(
                f"{other}: its {name.replace('_', ' ')} is {value} µm, that of {source} {first} µm; the latter is used",
                StackWarning,
                stacklevel=3,
            )
    return first
