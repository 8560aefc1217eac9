"""Annotations are enforced here, and only here: each call checks the shapes and types it was promised.

`make test` checks the first 4 calls of each function in each test, `make test-all` every one.
"""

import functools
import math
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import jaxtyping
import numpy as np
import pytest

# Idle OpenMP threads sleep: on a shared machine spinning ones cost small tensors a hundredfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch

jaxtyped = jaxtyping.jaxtyped
made: Counter[CodeType] = Counter()
called: Counter[CodeType] = Counter()
most_calls = math.inf


def checked_at_first(*, typechecker: Any) -> Callable:
    """jaxtyping's decorator, but it does not check what repeats itself.

    A function that another one defines is checked the first 5 times that it is defined: the import hook decorates each
    definition, to build the check takes milliseconds, and a solver defines functions at every step. Any other function
    is checked at its first `most_calls` calls in each test. A function's check is built when it is first called: a
    process imports all functions and calls some.
    """
    check = jaxtyped(typechecker=typechecker)

    def decorated(function: Any) -> Any:
        if not isinstance(function, FunctionType):
            return check(function)
        code = function.__code__
        if "<locals>" in function.__qualname__:
            made[code] += 1
            return check(function) if made[code] <= 5 else function
        checked = None

        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            nonlocal checked
            called[code] += 1
            if called[code] > most_calls:
                return function(*arguments, **named)
            if checked is None:
                checked = check(function)
            return checked(*arguments, **named)

        return call

    return decorated


jaxtyping.jaxtyped = checked_at_first

# int is accepted where float is asked for, as the type checker does (PEP 484's numeric tower).
jaxtyping.install_import_hook(
    ["torchdic", "data_synthetic", "recon"],
    "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))",
)

from torchdic import Acquisition, Condenser, Grid, Microscope, Objective, Prism  # noqa: E402

DATA = Path(__file__).parent / "data"
PROPAGATIONS = ("projection", "rays", "wave")


@pytest.fixture(autouse=True)
def _deterministic():
    """The same numbers in every test, whichever tests ran before it."""
    called.clear()
    torch.default_generator.manual_seed(0)  # torch's own function also asks for devices that aren't there
    before = torch.get_deterministic_debug_mode()
    # torch.use_deterministic_algorithms says the same, but imports torch's compiler
    torch.set_deterministic_debug_mode("error")
    yield
    torch.set_deterministic_debug_mode(before)


@pytest.fixture(params=PROPAGATIONS)
def propagation(request) -> str:
    return request.param


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture
def small() -> Grid:
    """Few voxels, all sizes unequal and both odd and even."""
    return Grid((4, 11, 14), (0.5, 0.2, 0.21))


@pytest.fixture
def microscope() -> Microscope:
    """Partially coherent, with an objective wider than its condenser; the small grid samples it well."""
    return Microscope(0.546, Objective(0.75), Condenser(0.4))


@pytest.fixture
def acquisition() -> Acquisition:
    """Both shear axes, unequal and tilted, a bright field between them, and focus planes out of order."""
    return Acquisition([Prism((0.05, 0.21), 1.1), None, Prism((0.17, -0.04), -0.7)], [0.6, -0.9])


@pytest.fixture
def load():
    """The reference images of tests/data by name, as tensors."""

    def read(name: str) -> dict[str, torch.Tensor]:
        with np.load(DATA / f"{name}.npz") as file:
            return {key: torch.from_numpy(np.asarray(file[key])) for key in file.files}

    return read


@pytest.fixture
def smooth_field():
    """A smooth random field (z, y, x) that is nowhere 0 or alike in any two axes; about ±size."""

    def make(grid: Grid, size: float = 1.0, dtype: torch.dtype = torch.float64, seed: int = 0) -> torch.Tensor:
        random = torch.Generator().manual_seed(seed)
        z, y, x = torch.meshgrid(*(grid.coordinates(axis, dtype=torch.float64) for axis in range(3)), indexing="ij")
        field = torch.zeros(grid.shape, dtype=torch.float64)
        for _ in range(8):
            fz, fy, fx, phase, part = torch.rand(5, generator=random, dtype=torch.float64).tolist()
            k = [math.pi * (2 * f - 1) * 0.9 for f in (fz, fy, fx)]
            field += (0.5 + part) * torch.cos(k[0] * z + k[1] * y + k[2] * x + 2 * math.pi * phase)
        return (size / 3 * field).to(dtype)

    return make


@pytest.fixture
def no_pictures(monkeypatch):
    """Figures are left as empty files: most of a short run's time is Matplotlib's."""
    monkeypatch.setattr("recon.report.figures.save", lambda _figure, path: path.touch())


@pytest.fixture(scope="session", autouse=True)
def _no_reports():
    """Commands leave an empty report.html; tests/test_report.py makes true ones, which take most of a second each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("recon.cli.running.leave_report", lambda out: (out / "report.html").touch())
        yield


@pytest.fixture(scope="session")
def measured_file():
    """A function from a name to the measured file; the test skips where it is absent."""

    def find(name):
        folder = os.environ.get("TORCHDIC_DATA")
        if not folder:
            pytest.skip("TORCHDIC_DATA is unset: no measured data")
        path = Path(folder) / name
        if not path.is_file():
            pytest.skip(f"TORCHDIC_DATA holds no {name}")
        return path

    return find


def pytest_configure(config):
    global most_calls
    most_calls = 4 if config.option.markexpr == "not slow" else math.inf


def pytest_addoption(parser):
    parser.addoption(
        "--table", action="store_true", help="print what was measured by test_stability.py and tests/faults"
    )


def pytest_terminal_summary(terminalreporter):
    """With --table, a row for each case and propagation of the stability matrix: law, what was measured, the most."""
    if not terminalreporter.config.getoption("--table"):
        return
    reports = [r for outcome in ("passed", "failed") for r in terminalreporter.getreports(outcome) if r.when == "call"]
    rows: dict[tuple[str, str], dict[tuple[str, str], str]] = {}
    for report in reports:
        for name, value in report.user_properties:
            if name == "stability":
                case, propagation, kind, dtype, law, measured, limit = value
                form = ".4f" if law == "light" else ".1e"
                numbers = f" {measured:{form}} ≤ {limit:{form}}" if limit else ""
                rows.setdefault((case, propagation), {})[kind, dtype] = law + numbers
    if not rows:
        return
    columns = [(kind, dtype) for kind in ("image", "gradient") for dtype in ("float64", "float32")]
    terminalreporter.section("stability")
    terminalreporter.write_line("| case | propagation | " + " | ".join(map(" ".join, columns)) + " |")
    terminalreporter.write_line("|---" * (2 + len(columns)) + "|")
    for (case, propagation), cells in sorted(rows.items()):
        terminalreporter.write_line(
            f"| {case} | {propagation} | " + " | ".join(cells.get(c, "") for c in columns) + " |"
        )
