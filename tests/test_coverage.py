"""What an acquisition can say of a specimen, before it is recorded."""

import json
import math
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
import torch

from recon.cli import main
from recon.config.reading import load
from recon.coverage.acquisition import NoisyAcquisition, shot_noise
from recon.coverage.changes import changes
from recon.coverage.expected import ExpectedSpecimen
from recon.coverage.resolution import finest_along_z, resolution_of, widths
from recon.coverage.seen import coverage
from recon.fit.newton.weak_hessian import cosines
from recon.fit.setup import Setup, empty_medium
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume
from torchdic.linear import linear_image

BACKGROUND = 1.4
SMALL = Grid((3, 6, 8), (0.5, 0.3, 0.25))
GRID = Grid((12, 32, 32), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
EXPECTED = ExpectedSpecimen(0.02, 0.6)
ALONG_X, ALONG_Y = (0.0, 0.24), (0.24, 0.0)
FIDELITY = Fidelity(sources=8)


@pytest.fixture(autouse=True)
def _few_directions(monkeypatch):
    monkeypatch.setattr("recon.coverage.acquisition.DIRECTIONS", 12)


def recording(prisms=((ALONG_X, 1.5),), focus=(-1.0, 0.0, 1.0), photons=4000.0, microscope=MICROSCOPE):
    noise = shot_noise(0.5, photons)
    acquisition = Acquisition([Prism(shear, bias) for shear, bias in prisms], focus)
    return NoisyAcquisition(GRID, BACKGROUND, microscope, acquisition, (noise,) * len(prisms))


def test_the_estimate_is_the_mean_of_gauss_and_bayes_on_every_voxel():
    """R·Δn beside the dense system of all pixels and voxels: (JᵀJ/σ² + P⁻¹)⁻¹·JᵀJ/σ²·Δn."""
    acquisition = Acquisition([Prism(ALONG_X, 1.5), Prism(ALONG_Y, -1.0)], [-0.7, 0.4])
    setup = Setup(empty_medium(SMALL, BACKGROUND, torch.zeros((), dtype=torch.float64)), MICROSCOPE, acquisition)
    noise = torch.tensor([[0.02, 0.02], [0.03, 0.03]], dtype=torch.float64)
    found = coverage(setup, noise, FIDELITY, EXPECTED)

    voxels = math.prod(SMALL.shape)

    def seen(delta):
        images = linear_image(Volume(SMALL, delta, BACKGROUND), MICROSCOPE, acquisition, FIDELITY)
        return images - linear_image(Volume(SMALL, 0 * delta, BACKGROUND), MICROSCOPE, acquisition, FIDELITY)

    units = torch.eye(voxels, dtype=torch.float64).reshape(voxels, *SMALL.shape)
    J = torch.stack([(seen(unit) / noise[..., None, None]).flatten() for unit in units], 1)
    # the expected covariance: each unit's coefficients times their power, and back
    along_z, power = cosines(3), EXPECTED.power(SMALL)

    def spread(delta):
        waves = torch.fft.rfft2(torch.tensordot(along_z, delta, 1)) * power.permute(2, 0, 1)
        return torch.tensordot(along_z.mT, torch.fft.irfft2(waves, s=SMALL.shape[1:]), 1)

    P = torch.stack([spread(unit).flatten() for unit in units], 1)
    told = torch.linalg.solve(J.mT @ J + torch.linalg.inv(P), J.mT @ J)
    delta = torch.randn(SMALL.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.estimate(delta).flatten(), told @ delta.flatten(), rtol=1e-6, atol=1e-8)
    assert found.number == pytest.approx(float(told.trace()), rel=1e-6)
    left = torch.linalg.inv(J.mT @ J + torch.linalg.inv(P))
    assert found.deviation == pytest.approx(math.sqrt(float(left.trace()) / voxels), rel=1e-6)
    assert found.known_before == pytest.approx(math.sqrt(float(P.trace()) / voxels), rel=1e-6)


def test_half_of_space_differs_by_the_contrast():
    """Δn of ±contrast/2 about its mean: the powers of all frequencies sum up to that, where voxels are fine enough."""
    grid = Grid((40, 40, 40), (0.25, 0.25, 0.25))
    power = ExpectedSpecimen(0.02, 1.0).power(grid)
    counts = torch.full((21,), 2.0, dtype=torch.float64)
    counts[0] = counts[-1] = 1
    assert float((power.sum(-1) * counts).sum()) / 40**3 == pytest.approx(0.01**2, rel=0.1)


@pytest.mark.parametrize(("name", "value"), [("contrast", 0.0), ("size", -1.0), ("size", math.inf)])
def test_an_expectation_that_is_none_is_refused(name, value):
    with pytest.raises(ValueError, match=rf"{name} {value} must be above 0"):
        ExpectedSpecimen(**{name: value})


def test_nothing_is_seen_of_a_mean_and_all_else_is_between_0_and_1():
    seen = recording().coverage(EXPECTED).seen
    assert float(seen.min()) > -1e-9
    assert float(seen.max()) < 1
    assert float(seen[0, 0].abs().max()) < 1e-9


def test_more_light_images_and_axes_see_more():
    few = recording().coverage(EXPECTED)
    for more in (
        recording(photons=16000),
        recording(focus=(-1.0, -0.5, 0.0, 0.5, 1.0)),
        recording(((ALONG_X, 1.5), (ALONG_Y, 1.5))),
    ):
        other = more.coverage(EXPECTED)
        assert other.number > few.number
        assert other.deviation < few.deviation
        assert float((other.seen - few.seen).min()) > -1e-9


def test_in_focus_phase_is_seen_along_the_shear_alone():
    """Across it the prism's two images are those of a bright field, in which phase in focus doesn't show."""
    flat = replace(recording(focus=(0.0,)), grid=Grid((1, 32, 32), GRID.spacing))
    seen = flat.coverage(EXPECTED).seen.sum(-1)
    assert float(seen[0, 4]) > 0.5 > 0.01 > float(seen[4, 0])


def test_a_wide_condenser_sees_finer_detail_along_z():
    narrow, wide = (
        recording(microscope=replace(MICROSCOPE, condenser=Condenser(na)), photons=1e6).coverage(EXPECTED)
        for na in (0.1, 0.7)
    )
    assert finest_along_z(wide, 2.0) < finest_along_z(narrow, 2.0)


def test_what_is_wide_across_z_is_not_seen_to_change_along_it():
    """The missing cone: two waves that make a wide structure beat slowly along z."""
    found = recording(photons=1e6).coverage(EXPECTED)
    periods = [finest_along_z(found, period) for period in (0.8, 1.6, 3.2)]
    assert periods[1] < periods[2]
    assert finest_along_z(found, 40.0) is None


def test_widths_are_those_of_a_ball_of_gauss():
    z, y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in (31, 41, 41))
    ball = torch.exp(-0.5 * ((z[:, None, None] / 3) ** 2 + (y[:, None] / 2) ** 2 + (x / 4) ** 2))
    found = widths(ball, (15, 20, 20), (0.5, 0.2, 0.2))
    full = math.sqrt(8 * math.log(2))
    assert found.axial == pytest.approx(full * 3 * 0.5, rel=0.02)
    assert found.finest == pytest.approx(full * 2 * 0.2, rel=0.03)
    assert found.coarsest == pytest.approx(full * 4 * 0.2, rel=0.03)
    assert found.direction == 0.0


@pytest.mark.parametrize("shape", [(1, 9, 9), (3, 1, 9), (3, 9, 1), (1, 1, 1), (2, 2, 2)])
def test_along_an_axis_of_few_voxels_a_point_is_as_wide_as_the_volume(shape):
    found = widths(torch.ones(shape, dtype=torch.float64), tuple(n // 2 for n in shape), (0.5, 0.2, 0.2))
    assert (found.axial, found.finest, found.coarsest) == (math.inf, math.inf, math.inf)


def test_a_point_is_widest_along_z():
    found = resolution_of(recording(focus=(-2.0, -1.0, 0.0, 1.0, 2.0)).coverage(EXPECTED))
    assert found.axial > 2 * found.coarsest >= 2 * found.finest > 0


def test_shot_noise_is_that_of_the_photons_and_the_camera():
    assert shot_noise(0.5, 4000) == pytest.approx(math.sqrt(0.5 / 4000))
    assert shot_noise(0.5, 100, 5.0) == pytest.approx(math.sqrt(50 + 25) / 100)


def test_changes_are_those_that_make_sense():
    names = [change.name for change in changes(recording())]
    assert any("second shear axis" in name for name in names)
    assert any("opposite bias" in name for name in names)
    assert any("condenser opened to the objective's NA 0.8" in name for name in names)
    both = ((ALONG_X, 1.5), (ALONG_X, -1.5), (ALONG_Y, 1.5), (ALONG_Y, -1.5))
    open_wide = replace(MICROSCOPE, condenser=Condenser(0.8))
    names = [change.name for change in changes(recording(both, microscope=open_wide))]
    assert not any(word in name for name in names for word in ("axis", "bias", "condenser"))


def test_a_second_axis_is_across_the_first():
    change = next(c for c in changes(recording()) if "axis" in c.name)
    one, other = (np.array(p.shear) for p in change.recording.acquisition.prisms)
    assert abs(one @ other) < 1e-12
    assert np.hypot(*one) == pytest.approx(np.hypot(*other))
    assert change.images == 2


@pytest.mark.parametrize("focus", [(0.3,), (0.0, 1.0), (-1.0, 0.0, 1.0)])
def test_planes_are_added_at_both_ends_and_between(focus):
    made = [c.recording.focus for c in changes(recording(focus=focus)) if "plane" in c.name]
    assert made
    assert all(planes == sorted(planes) for planes in made)
    for planes in made:
        assert set(focus) <= set(planes) or set(planes) < set(focus)


# --- the command ------------------------------------------------------------------------------------------------------

CONFIG = """
[volume]
shape = [8, 24, 24]
spacing = [0.5, 0.2, 0.2]
background = 1.4
[microscope]
wavelength = 0.546
objective = { na = 0.8 }
condenser = { na = 0.5 }
camera = { photons = 4000, read_noise = 2.0 }
[acquisition]
focus = [-1.0, 0.0, 1.0]
prisms = [ { shear = { length = 0.24, angle_degrees = 20 }, bias_degrees = 85 } ]
"""


@pytest.fixture
def covered(tmp_path, capsys):
    """A function from changes of the configuration {section: {key: value}} to (exit code, stdout, stderr)."""

    def call(changed=None, *options):
        values = tomllib.loads(CONFIG)
        for section, keys in (changed or {}).items():
            values.setdefault(section, {}).update(keys)
        (tmp_path / "run.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
        code = main(["coverage", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out"), *options])
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.mark.parametrize("volume", [False, True])
def test_beside_a_volume_the_configuration_that_it_was_fitted_with_stays(covered, tmp_path, volume):
    """`error-bars` fits again by it."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "config.resolved.toml").write_text("of the fit", encoding="utf-8")
    if volume:
        (folder / "volume.ome.tif").write_bytes(b"")
    assert covered()[0] == 0
    kept = (folder / "config.resolved.toml").read_text(encoding="utf-8") == "of the fit"
    assert kept is volume
    own = folder / ("coverage.resolved.toml" if volume else "config.resolved.toml")
    assert load(own).acquisition.focus == (-1.0, 0.0, 1.0)
    if volume:
        assert "coverage.resolved.toml" in (folder / "README.txt").read_text(encoding="utf-8")


def test_the_command_leaves_numbers_and_a_picture(covered, tmp_path):
    code, out, _ = covered()
    assert code == 0
    assert "a point's width" in out
    assert "1.1 % of the bright field, of 4000 photons" in out
    found = json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))
    assert 0 < found["seen_share"] < 1
    assert found["deviation"] < found["deviation_before"]
    assert found["changes"] == []
    assert (tmp_path / "out" / "coverage.png").stat().st_size > 10000
    assert covered()[0] == 2  # the folder holds results
    assert covered(None, "--restart")[0] == 0


def test_one_slice_tells_no_width_along_z(covered, tmp_path):
    """As torchdic new makes of a single image."""
    code, out, _ = covered({"volume": {"shape": [1, 24, 24]}, "acquisition": {"focus": [0.0]}}, "--suggest")
    assert code == 0
    assert re.search(r"a point's width +0\.\d+ µm across z.*, more than the volume's 0\.5 µm along z", out)
    assert "inf" not in out
    found = json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))
    assert found["point_width_um"]["axial"] is None


def test_suggestions_are_ranked_by_what_they_add(covered, tmp_path):
    _, out, _ = covered(None, "--suggest")
    found = json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))
    numbers = [change["seen_number"] for change in found["changes"]]
    assert len(numbers) >= 5
    assert numbers == sorted(numbers, reverse=True)
    assert "a second shear axis, across the first" in out


@pytest.mark.slow
def test_a_sharper_expectation_changes_what_is_seen(covered, tmp_path):
    shares = []
    for contrast in (0.005, 0.05):
        covered({"coverage": {"contrast": contrast}}, "--restart")
        shares.append(json.loads((tmp_path / "out" / "coverage.json").read_text(encoding="utf-8"))["seen_share"])
    assert shares[0] < shares[1]


def test_images_that_show_nothing_are_told_in_one_line(covered, tmp_path):
    code, _, err = covered(
        {"acquisition": {"prisms": [{"shear": {"length": 0.24, "angle_degrees": 20}, "bias_degrees": 0}]}}
    )
    assert code == 2
    assert err.count("\n") == 1
    assert "show nothing of a weak specimen" in err
    assert not (tmp_path / "out").exists()


def test_without_noise_nothing_is_told(covered):
    code, _, err = covered({"microscope": {"camera": {}}})
    assert code == 2
    assert "microscope.camera.photons" in err
    assert err.count("\n") == 1


def test_a_stack_that_says_next_to_nothing_says_so(covered):
    """One plane, a point of light, fifty photons."""
    code, out, _ = covered(
        {
            "microscope": {"camera": {"photons": 50}, "condenser": {"na": 0.0}},
            "acquisition": {"focus": [0.0]},
        }
    )
    assert code == 0
    assert out.count("tell next to nothing of such a specimen") == 1


@pytest.mark.filterwarnings("ignore")
def test_a_plan_says_what_is_seen_in_one_line(tmp_path, capsys):
    noisy = "tolerance = 0.3\n" + CONFIG + '[specimen]\nkind = "bead"\nradius = 0.8\ncontrast = 0.02\n'
    for text, told in ((noisy, True), (noisy.replace("camera = { photons = 4000, read_noise = 2.0 }", ""), False)):
        (tmp_path / "run.toml").write_text(text, encoding="utf-8")
        assert main(["plan", str(tmp_path / "run.toml"), "--device", "cpu"]) == 0
        assert ("of the frequencies; a point's width" in capsys.readouterr().out) is told


def test_a_plan_whose_stack_is_too_small_to_tell_its_noise_is_a_plan(tmp_path, capsys):
    row = CONFIG.replace("[8, 24, 24]", "[2, 1, 24]").replace("camera = { photons = 4000, read_noise = 2.0 }", "")
    text = f'tolerance = 0.3\n{row}[specimen]\nkind = "bead"\nradius = 0.8\ncontrast = 0.02\n'
    (tmp_path / "run.toml").write_text(f'{text}[data]\npath = "made/stack.ome.tif"\n', encoding="utf-8")
    assert main(["simulate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "made"), "--device", "cpu"]) == 0
    assert main(["plan", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    assert (tmp_path / "out" / "plan.json").exists()
