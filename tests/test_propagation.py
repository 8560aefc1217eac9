"""A propagation is one object: a toy one, of this file alone, does all that those of torchdic do."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from recon.config import ConfigError, load
from torchdic import (
    Acquisition,
    Candidate,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    Volume,
    foreseen,
    image,
    plan,
    work_precision,
)
from torchdic.fidelity import PROPAGATIONS
from torchdic.planning.work_precision import converged_fidelities, ladder, peak_bytes
from torchdic.propagation.base import Crossing, Propagation, register

GRID = Grid((3, 24, 26), (0.1, 0.2, 0.21))
SCOPE = Microscope(0.546, Objective(0.6), Condenser(0.2))
ACQUISITION = Acquisition([Prism((0.05, 0.2), 1.1), None], [0.3, -0.4])


class Screen(Propagation):
    """All of Δn as one thin phase screen, whatever the light's direction."""

    name = "screen"

    def check(self, fidelity):
        if not fidelity.amplitude:
            raise ValueError(f'amplitude {fidelity.amplitude} has no use in propagation "screen"')

    def prepare(self, volume, fidelity, plane, *, polarised=False):
        return ThroughScreen(volume)

    def work(self, grid, fidelity, *, absorbs):
        return 0.5

    def describe(self, fidelity):
        return ["one screen"]

    def planned(self):
        return [Fidelity(self.name)]

    def rungs(self, grid, margin):
        return [(Fidelity(self.name, sources=12), None), (Fidelity(self.name), "float64")]


@dataclass(frozen=True, eq=False)
class ThroughScreen(Crossing):
    volume: Volume

    def spectrum(self, wavelength, momentum, *, slabs=False, to_spectrum=torch.fft.fft2):
        path = self.volume.delta.sum(0) * self.volume.grid.spacing[0]
        phase = (2 * math.pi / wavelength) * path.expand(len(momentum), 1, -1, -1)
        return to_spectrum(torch.polar(torch.ones_like(phase), phase))


@pytest.fixture(autouse=True)
def screen():
    register(Screen())
    yield
    del PROPAGATIONS["screen"]


def specimen(smooth_field, size=0.01, dtype=torch.float64, *, learned=False) -> Volume:
    y, x = (torch.hann_window(n, periodic=False, dtype=torch.float64) for n in GRID.shape[1:])
    delta = (smooth_field(GRID, size) * (y[:, None] * x).square()).to(dtype)
    return Volume(GRID, delta.requires_grad_(learned), 1.36)


def test_it_makes_images(smooth_field):
    """Of a thin specimen about those of straight rays."""
    volume = specimen(smooth_field)
    found, straight = (image(volume, SCOPE, ACQUISITION, Fidelity(way)) for way in ("screen", "projection"))
    assert found.shape == (2, 2, 24, 26)
    contrast = straight.std((2, 3), correction=0)
    assert float(((found - straight).square().mean((2, 3)).sqrt() / contrast).max()) < 0.02


def test_its_gradient_is_that_of_central_differences(smooth_field):
    volume, way = specimen(smooth_field, learned=True), smooth_field(GRID, seed=1)

    def total(delta: Tensor) -> Tensor:
        return image(Volume(GRID, delta, 1.36), SCOPE, ACQUISITION, Fidelity("screen")).square().sum()

    (gradient,) = torch.autograd.grad(total(volume.delta), volume.delta)
    step = 1e-6
    with torch.no_grad():
        slope = float(total(volume.delta + step * way) - total(volume.delta - step * way)) / (2 * step)
    assert float((gradient * way).sum()) == pytest.approx(slope, rel=1e-6)


def test_it_is_batched_and_foreseen(smooth_field):
    """Within 30 % of what is held, whole and in batches, with the same images."""
    volume = specimen(smooth_field, dtype=torch.float32, learned=True)
    whole = foreseen(volume, SCOPE, ACQUISITION, Fidelity("screen"))
    assert whole.sources == len(SCOPE.sources(40)[1])
    for memory in (1 << 40, whole.peak // 2):
        fidelity = Fidelity("screen", memory=memory)
        found = foreseen(volume, SCOPE, ACQUISITION, fidelity)
        assert found.peak <= memory

        def gradient(fidelity=fidelity):
            volume.delta.grad = None
            image(volume, SCOPE, ACQUISITION, fidelity).sum().backward()

        assert found.peak / peak_bytes(gradient)[1] == pytest.approx(1, abs=0.3)
    assert found.sources < whole.sources
    images = [image(volume, SCOPE, ACQUISITION, Fidelity("screen", memory=m)) for m in (1 << 40, whole.peak // 2)]
    torch.testing.assert_close(*images, rtol=1e-5, atol=1e-6)


def test_it_is_planned_where_it_is_good_enough_and_cheapest(smooth_field):
    found = plan(specimen(smooth_field, dtype=torch.float32), SCOPE, ACQUISITION, 0.1)
    assert found.met
    assert found.fidelity.propagation == "screen"
    assert '"screen", one screen' in found.table()
    thick = Volume(replace(GRID, spacing=(1.5, 0.2, 0.21)), 4 * specimen(smooth_field).delta, 1.36)
    assert plan(thick, SCOPE, ACQUISITION, 0.05).fidelity.propagation != "screen"


def test_its_work_and_precision_are_measured(smooth_field):
    volume = specimen(smooth_field, dtype=torch.float32)
    rungs = [rung for rung in ladder(GRID) if rung.fidelity.propagation == "screen"]
    assert rungs == [Candidate(Fidelity("screen", sources=12)), Candidate(Fidelity("screen"), "float64")]
    references = {"wave": Fidelity("wave", sources=50), "screen": Fidelity("screen", sources=50)}
    assert set(references) == set(converged_fidelities(rungs, GRID))
    few, many = work_precision(volume, SCOPE, ACQUISITION, rungs, references, repeats=1)
    assert few.failure is None
    assert many.numerical_error < few.numerical_error < few.model_error
    assert few.gradient_peak_bytes > few.peak_bytes > 0


def test_it_checks_its_part_of_a_fidelity():
    with pytest.raises(ValueError, match=r"amplitude False has no use in propagation \"screen\""):
        Fidelity("screen", amplitude=False)
    with pytest.raises(ValueError, match=r"propagation 'beam' must be one of 'projection', 'rays', 'wave', 'screen'"):
        Fidelity("beam")


def test_a_configuration_names_it(tmp_path):
    lines = """
    [volume]
    shape = [3, 24, 26]
    spacing = [0.1, 0.2, 0.21]
    background = 1.36
    [microscope]
    wavelength = 0.546
    [acquisition]
    [fidelity]
    propagation = "{}"
    """
    path = tmp_path / "scene.toml"
    path.write_text(lines.format("screen"), encoding="utf-8")
    config = load(path)
    assert config.fidelity is not None
    assert config.fidelity.propagation == "screen"
    path.write_text(lines.format("beam"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"scene.toml: fidelity.*'beam' must be one of .*'screen'"):
        load(path)
