"""Whether two steps of a descent are the same to the last bit."""

import dataclasses

import torch


def same(a, b):
    """Bit for bit, dicts, sequences and tensors alike."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def alike(a, b):
    """Whether two steps are bit for bit the same, but for their seconds."""
    names = [f.name for f in dataclasses.fields(a) if f.name != "seconds"]
    return all(same(getattr(a, name), getattr(b, name)) for name in names)
