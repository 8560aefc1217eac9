"""What is given in place of what a name takes is named in the error, in a program where no types are checked."""

import os
import subprocess
import sys

SESSION = """
import numpy as np, torch
from torchdic import Acquisition, Fidelity, Grid, Microscope, Objective, Prism, Rays, Volume
MISTAKES = (
    lambda: Volume(Grid((2, 3, 4), (1, 1, 1)), np.zeros((2, 3, 4)), 1.33),
    lambda: Microscope(0.55, 0.9),
    lambda: Microscope(0.55, Objective(0.9), 0.5),
    lambda: Acquisition([None], 0.5),
    lambda: Acquisition(Prism((0.0, 0.2), 1.0)),
    lambda: Fidelity("wave", sources=2.5),
    lambda: Fidelity("wave", steps=2.5),
    lambda: Rays(torch.zeros(3, 3), torch.zeros(3, 2), torch.zeros(3)).like(torch.zeros(())),
    lambda: Rays(torch.zeros(3, 2), torch.zeros(2, 2), torch.zeros(3)).like(torch.zeros(())),
)
for mistake in MISTAKES:
    try:
        mistake()
    except (TypeError, ValueError) as error:
        print(error)
"""


def test_what_is_given_is_named_beside_what_it_must_be():
    words, utf8 = [sys.executable, "-c", SESSION], {**os.environ, "PYTHONUTF8": "1"}
    said = subprocess.run(words, env=utf8, capture_output=True, encoding="utf-8", check=True).stdout
    assert said.splitlines() == [
        "delta is of <class 'numpy.ndarray'>: it must be a tensor, as torch.as_tensor makes one",
        "objective 0.9 must be Objective(…) or None",
        "condenser 0.5 must be Condenser(…) or None",
        "focus 0.5 must be a sequence, such as [0.0]",
        "prisms Prism(shear=(0.0, 0.2), bias=1.0, axis=None) must be a sequence, such as [Prism(…)]",
        "sources 2.5 must be a whole number of at least 1",
        "steps 2.5 must be a whole number of at least 1",
        "position has shape (3, 3), not (…, 2), (y, x)",
        "position (3, 2), momentum (2, 2), opd (3,) aren't of as many rays",
    ]
