"""The camera: pixels that see their whole area, noise from the given generator alone, and counts."""

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
import torch

from data_synthetic import Bead
from recon.cli import main
from recon.config.conversion import dump
from recon.config.reading import load
from recon.config.schema import ConfigError
from recon.run.data import load_data
from recon.run.exact_images import exact_images
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    Volume,
    image,
    image_field,
)
from torchdic.files.stack import read_stack, read_volume


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("level", [0.02, 0.5, 1.0])
@pytest.mark.parametrize(("photons", "read_noise"), [(50, None), (5000, None), (200, 4.0), (1000, 0.0)])
def test_the_mean_is_the_intensity_and_the_variance_that_of_photons_and_read_out(level, photons, read_noise, dtype):
    n = 200_000
    recorded = Camera(photons, read_noise).record(torch.full((n,), level, dtype=dtype), seeded())
    variance = level / photons + ((read_noise or 0) / photons) ** 2
    assert recorded.dtype == dtype
    # 5 standard errors; a Poisson count's fourth moment is 3σ⁴ + σ²
    assert abs(float(recorded.mean()) - level) < 5 * math.sqrt(variance / n)
    spread = math.sqrt((2 + 1 / (level * photons)) / n)
    assert float(recorded.var()) == pytest.approx(variance, rel=5 * spread)


def test_the_same_seed_gives_the_same_noise_and_another_one_another():
    camera, intensity = Camera(100, 2.0), torch.rand(3, 2, 9, 7)
    once, again, other = (camera.record(intensity, seeded(seed)) for seed in (1, 1, 2))
    assert once.shape == intensity.shape
    assert torch.equal(once, again)
    assert not torch.equal(once, other)


def test_the_generator_alone_decides():
    camera, intensity = Camera(100, 2.0), torch.rand(9, 7)
    torch.manual_seed(3)
    once = camera.record(intensity, seeded())
    torch.manual_seed(4)
    assert torch.equal(camera.record(intensity, seeded()), once)


def test_without_photons_nothing_is_added():
    intensity = torch.rand(9, 7)
    assert torch.equal(Camera().record(intensity, seeded()), intensity)


def test_without_read_noise_counts_are_whole_and_darkness_is_dark():
    counts = 250 * Camera(250).record(torch.rand(40, 50, dtype=torch.float64), seeded())
    assert torch.allclose(counts, counts.round(), rtol=0, atol=1e-9)
    assert float(Camera(250).record(torch.zeros(40, 50), seeded()).abs().max()) == 0


@pytest.mark.parametrize(
    ("values", "law"),
    [
        ({"photons": 0.0}, "photons 0.0 .* must be above 0"),
        ({"photons": -5.0}, "photons -5.0 .* must be above 0"),
        ({"photons": math.nan}, "photons nan .* must be above 0"),
        ({"photons": math.inf}, "photons inf .* must be above 0"),
        ({"photons": 10.0, "read_noise": -1.0}, "read_noise -1.0 electrons must be at least 0"),
        ({"photons": 10.0, "read_noise": math.nan}, "read_noise nan electrons must be at least 0"),
        ({"read_noise": 2.0}, "read_noise 2.0 electrons needs photons"),
        ({"photons": 10.0, "gain": 2.0}, "gain 2.0 is in counts, of which there are none without bits"),
        ({"photons": 10.0, "offset": 0.0}, "offset 0.0 is in counts"),
        ({"bits": 8}, "bits 8 needs photons, or a gain"),
        ({"photons": 10.0, "bits": 0}, "bits 0 must be from 1 to 16"),
        ({"photons": 10.0, "bits": 17}, "bits 17 must be from 1 to 16"),
        ({"gain": -1.0, "bits": 8}, "gain -1.0 counts per electron must be above 0"),
        ({"photons": 10.0, "offset": math.inf, "bits": 8}, "offset inf counts must be finite"),
        ({"pixel_size": 0.0}, "pixel_size 0.0 must be above 0"),
        ({"pixel_size": 6.5, "magnification": -1.0}, "magnification -1.0 must be above 0"),
        ({"magnification": 60.0}, "magnification 60.0 needs the pixel_size"),
    ],
)
def test_an_unphysical_camera_is_refused(values, law):
    with pytest.raises(ValueError, match=law):
        Camera(**values)


# --- counts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bits", "dtype"), [(1, torch.uint8), (8, torch.uint8), (9, torch.uint16), (16, torch.uint16)])
def test_saturation_clips_exactly_at_the_largest_count(bits, dtype):
    largest = 2**bits - 1
    levels = torch.tensor([0.0, 0.5, 1.0, 1.0 + 0.4 / largest, 1.0 + 1 / largest, 7.0], dtype=torch.float64)
    counts = Camera(gain=float(largest), bits=bits).record(levels, seeded())
    assert counts.dtype == dtype
    assert counts.tolist() == [0, round(largest / 2), largest, largest, largest, largest]
    assert Camera(gain=1.0, offset=-9.0, bits=bits).record(levels, seeded()).tolist() == [0] * 6


def test_gain_and_offset_are_affine_in_the_electrons():
    """The same seed draws the same electrons: whole ones, so that a whole gain and offset leave nothing to round."""
    intensity = torch.rand(40, 50, dtype=torch.float64)
    electrons = (Camera(300).record(intensity, seeded()) * 300).round().int()
    for gain, offset in ((None, None), (3.0, None), (None, 100.0), (5.0, 70.0), (2.0, 0.0)):
        counts = Camera(300, gain=gain, offset=offset, bits=16).record(intensity, seeded())
        assert torch.equal(counts.int(), (gain or 1) * electrons + (offset or 0))


def test_counts_have_the_mean_and_variance_of_electrons_times_gain():
    n, photons, read_noise, gain, offset, level = 200_000, 2000, 6.0, 4.0, 100.0, 0.6
    camera = Camera(photons, read_noise, gain, offset, 16)
    counts = camera.record(torch.full((n,), level, dtype=torch.float64), seeded()).double()
    # rounding adds 1/12
    variance = gain**2 * (level * photons + read_noise**2) + 1 / 12
    assert abs(float(counts.mean()) - gain * level * photons - offset) < 5 * math.sqrt(variance / n)
    assert float(counts.var()) == pytest.approx(variance, rel=5 * math.sqrt(2 / n))


def test_counts_of_a_seed_are_reproduced_bit_for_bit():
    camera, intensity = Camera(500, 2.0, 1.7, 30.0, 12), torch.rand(3, 2, 9, 7)
    once, again, other = (camera.record(intensity, seeded(seed)).int() for seed in (1, 1, 2))
    assert torch.equal(once, again)
    assert not torch.equal(once, other)


def test_read_noise_of_zero_is_none_but_a_value():
    """It draws its zeros: the electrons are the same, the generator has moved on."""
    intensity = torch.rand(30, 30, dtype=torch.float64)
    with_zero, without = seeded(), seeded()
    assert torch.equal(Camera(100, 0.0).record(intensity, with_zero), Camera(100).record(intensity, without))
    assert not torch.equal(with_zero.get_state(), without.get_state())


# --- pixels --------------------------------------------------------------------------------------------------------

N0 = 1.36
GRID = Grid((3, 12, 18), (0.4, 0.2, 0.2))


def waves(grid, y, x):
    """A trigonometric polynomial that the grid holds."""
    ly, lx = grid.extent[1:]
    return 1 + 0.5 * torch.cos(2 * math.pi * (2 * y / ly - x / lx) + 0.4) + 0.3 * torch.sin(10 * math.pi * x / lx)


@pytest.mark.parametrize(("size", "magnification"), [(0.4, None), (24.0, 60.0), (0.3, None), (0.2, None), (0.25, None)])
def test_pixel_sees_the_mean_over_its_area(size, magnification):
    """Against a Gauss rule in each pixel, for whole, rational and smaller multiples of the voxel."""
    camera = Camera(pixel_size=size, magnification=magnification)
    side = size / (magnification or 1)
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    found = camera.integrate(waves(GRID, y, x), (0.2, 0.2))
    rows, columns = camera.pixels((12, 18), (0.2, 0.2))
    assert found.shape == (rows, columns) == (int(2.4 / side + 1e-6), int(3.6 / side + 1e-6))
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(12))
    centres = [(torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * side for n in (rows, columns)]
    ys, xs = (c[:, None] + side / 2 * nodes for c in centres)
    inside = waves(GRID, ys[:, None, :, None], xs[None, :, None, :])
    expected = torch.einsum("rcyx,y,x->rc", inside, weights / 2, weights / 2)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [0.2, 0.3, 0.4, 0.6, 1.2])
def test_pixels_that_fill_the_image_conserve_its_energy(size, dtype):
    intensity = torch.rand(2, 12, 18, dtype=dtype)
    found = Camera(pixel_size=size).integrate(intensity, (0.2, 0.2))
    energy = found.double().sum((-1, -2)) * size**2
    torch.testing.assert_close(
        energy, intensity.double().sum((-1, -2)) * 0.04, rtol=40 * torch.finfo(dtype).eps, atol=0
    )


def test_image_is_what_the_cameras_pixels_see_of_it(smooth_field, acquisition, propagation):
    volume = Volume(GRID, smooth_field(GRID, 0.03), N0)
    camera, fidelity = Camera(pixel_size=39.0, magnification=100.0), Fidelity(propagation)
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4))
    plain = image(volume, scope, acquisition, fidelity)
    found = image(volume, replace(scope, camera=camera), acquisition, fidelity)
    assert found.shape == (3, 2, 6, 9)
    torch.testing.assert_close(found, camera.integrate(plain, (0.2, 0.2)), rtol=0, atol=1e-14)
    for absent in (Camera(), Camera(500, 2.0, bits=12)):
        assert torch.equal(image(volume, replace(scope, camera=absent), acquisition, fidelity), plain)


def test_padding_stays_outside_the_cameras_pixels():
    """A specimen that is nowhere but in the padding's middle: pixels with padding are those of the wider image."""
    transmission = torch.polar(torch.ones(12, 18, dtype=torch.float64), torch.rand(12, 18, dtype=torch.float64))
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4), Camera(pixel_size=0.4))
    found = image_field(transmission, GRID, scope, Acquisition(), background=N0, fidelity=Fidelity(padding=2))
    wide = torch.nn.functional.pad(transmission, (2, 2, 2, 2), value=1.0)
    by_hand = image_field(wide, Grid((3, 16, 22), GRID.spacing), scope, Acquisition(), background=N0)
    torch.testing.assert_close(found, by_hand[..., 1:-1, 1:-1], rtol=0, atol=1e-13)


def test_empty_field_is_sin2_half_bias_on_any_pixels(propagation):
    volume = Volume(GRID, torch.zeros(GRID.shape, dtype=torch.float64), N0)
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4), Camera(pixel_size=0.35))
    images = image(volume, scope, Acquisition([None, Prism((0.1, 0.2), 1.1)]), Fidelity(propagation))
    expected = torch.tensor([1.0, math.sin(0.55) ** 2], dtype=torch.float64)
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=1e-13)


def test_gradient_goes_through_the_pixels(smooth_field, acquisition):
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4), Camera(500, bits=12, pixel_size=0.3))

    def of(delta):
        return image(Volume(GRID, delta, N0), scope, acquisition, Fidelity("wave", sources=6)).square().sum()

    delta, direction = smooth_field(GRID, 0.03).requires_grad_(), smooth_field(GRID, 1.0, seed=1)
    (gradient,) = torch.autograd.grad(of(delta), delta)
    with torch.no_grad():
        at = [float(of(delta + i * 1e-5 * direction)) for i in (-2, -1, 1, 2)]
    expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / 12e-5
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)


def test_exact_images_are_on_the_cameras_pixels_too(acquisition):
    scope, bead = Microscope(0.546, Objective(0.75), Condenser(0.4)), Bead(0.5, 0.02, N0)
    camera = Camera(pixel_size=0.4)
    plain = exact_images(bead, GRID, scope, acquisition, Fidelity("wave", sources=6))
    found = exact_images(bead, GRID, replace(scope, camera=camera), acquisition, Fidelity("wave", sources=6))
    assert found.shape == (3, 2, 6, 9)
    # a cropped image is periodic no more, so the comparison is with the mean of 2 × 2 samples, of second order
    coarse = torch.nn.functional.avg_pool2d(plain, 2)
    assert float((found - coarse).abs().max()) < 0.1 * float(plain.amax() - plain.amin())


def test_pixel_larger_than_the_image_is_an_error():
    with pytest.raises(ValueError, match=r"a pixel of 3 µm doesn't fit into an image of 2\.4 × 3\.6 µm"):
        Camera(pixel_size=3.0).integrate(torch.ones(12, 18), (0.2, 0.2))


# --- command line --------------------------------------------------------------------------------------------------

CONFIG = {
    "volume": {"shape": [4, 36, 32], "spacing": [0.5, 0.2, 0.2], "background": 1.5},
    "microscope": {
        "wavelength": 0.546,
        "objective": {"na": 0.7},
        "condenser": {"na": 0.4},
        "camera": {"photons": 20000.0, "read_noise": 3.0, "gain": 0.19, "offset": 100.0, "bits": 12},
    },
    "acquisition": {"focus": [-1.0, 0.0, 1.0], "prisms": [{"shear": [0.0, 0.24], "bias": 1.5}]},
    "fidelity": {"sources": 6, "order": 1},
    "reconstruction": {"steps": 3, "draft_sources": "none"},
    "specimen": {"kind": "gaussian_ball", "sigma": 0.5, "contrast": 0.02, "centre": [0.3, -0.3, 0.4]},
    "data": {"path": "simulated/stack.ome.tif", "offset": 100.0, "flatten": False},
}


@pytest.fixture
def config(tmp_path):
    def put(**camera):
        scope = CONFIG["microscope"] | {"camera": CONFIG["microscope"]["camera"] | camera}
        path = tmp_path / "config.toml"
        path.write_text(tomli_w.dumps(CONFIG | {"microscope": scope}), encoding="utf-8")
        return path

    return put


@pytest.mark.usefixtures("no_pictures")
def test_simulated_counts_are_integers_that_a_reconstruction_scales_back(config, tmp_path):
    path = config()
    assert main(["simulate", str(path), "--out", str(tmp_path / "simulated"), "--device", "cpu"]) == 0
    stack = read_stack(tmp_path / "simulated" / "stack.ome.tif")
    assert stack.data.dtype == np.uint16
    assert 100 < stack.data.min() < stack.data.max() < 4096
    loaded = load(path)
    clean = tmp_path / "clean.toml"
    scope = {name: part for name, part in CONFIG["microscope"].items() if name != "camera"}
    clean.write_text(tomli_w.dumps(CONFIG | {"microscope": scope}), encoding="utf-8")
    assert main(["simulate", str(clean), "--out", str(tmp_path / "clean"), "--device", "cpu"]) == 0
    expected = read_stack(tmp_path / "clean" / "stack.ome.tif").data
    found = load_data(loaded).data
    # shot noise above all: 0.5 % of the empty bright field; the background's level to a part of that
    assert float((found - expected).std()) == pytest.approx(math.sqrt(0.5 / 20000), rel=0.15)
    assert abs(float((found - expected).mean())) < 1e-3
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    assert (tmp_path / "out" / "volume.ome.tif").exists()


@pytest.mark.parametrize(
    "microscope",
    [
        {"polarisation": {"analyser_extinction": 0.05, "analyser_error": 0.1}},
        {"polarisation": {"pupil": {"retardance": {"5": [0.0, 1.0], "6": [0.8, 0.0]}}}},
        {"condenser": {"na": 0.9}},  # wider than the objective, which stops some of its light
        {"condenser_prism": False},
    ],
    ids=["leaking polarisers", "strained lenses", "stopped light", "no condenser prism"],
)
@pytest.mark.usefixtures("no_pictures")
def test_counts_are_scaled_to_the_empty_field_of_the_microscope_that_is_declared(tmp_path, microscope):
    """Not to sin²(bias/2), which is that of an ideal one."""
    camera = CONFIG["microscope"]["camera"]
    stacks = {}
    for name, further, offset in (("counts", {"camera": camera}, camera["offset"]), ("clean", {}, 0.0)):
        scope = {k: v for k, v in CONFIG["microscope"].items() if k != "camera"} | microscope | further
        path = tmp_path / f"{name}.toml"
        data = {"path": str(tmp_path / name / "stack.ome.tif"), "offset": offset}
        parts = {"microscope": scope, "data": data, "reconstruction": {"method": "adam", "start": "zero"}}
        path.write_text(tomli_w.dumps(CONFIG | parts), encoding="utf-8")
        assert main(["simulate", str(path), "--out", str(tmp_path / name), "--device", "cpu"]) == 0
        stacks[name] = load_data(load(path))
    found, expected = stacks["counts"].data, stacks["clean"].data
    bias = CONFIG["acquisition"]["prisms"][0]["bias"]
    assert abs(float(expected.mean()) - math.sin(bias / 2) ** 2) > 0.005
    assert abs(float((found - expected).mean())) < 0.002


def test_simulated_pixels_are_the_cameras_and_their_size_is_in_the_file(config, tmp_path):
    path = config(pixel_size=24.0, magnification=60.0)
    assert main(["simulate", str(path), "--out", str(tmp_path / "simulated"), "--device", "cpu"]) == 0
    stack = read_stack(tmp_path / "simulated" / "stack.ome.tif")
    assert stack.data.shape == (1, 3, 18, 16)
    assert stack.pixel_size == pytest.approx((0.4, 0.4))


@pytest.mark.parametrize("side", [0.2, 0.4, 0.13])
def test_what_a_pixel_passes_of_a_wave_is_what_its_mean_leaves(side):
    """Of each wave that is below the pixels' own Nyquist frequency, one amplitude: the waves of 12 × 15 voxels."""
    (ny, nx), spacing = (12, 15), (0.2, 0.2)
    camera = Camera(pixel_size=side)
    passed = camera.passed((ny, nx), spacing)
    assert passed.shape == (ny, nx // 2 + 1)
    assert torch.equal(Camera().passed((ny, nx), spacing), torch.ones_like(passed))
    y, x = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in (ny, nx))
    for row, column in ((0, 0), (0, 2), (1, 1), (2, 0), (1, 2)):
        wave = torch.cos(2 * math.pi * row * y / ny)[:, None] * torch.cos(2 * math.pi * column * x / nx)
        rows, columns = camera.pixels((ny, nx), spacing)
        v, u = ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * side for n in (rows, columns))
        sampled = torch.cos(2 * math.pi * row * v / (ny * 0.2))[:, None] * torch.cos(
            2 * math.pi * column * u / (nx * 0.2)
        )
        found = camera.integrate(wave, spacing)
        torch.testing.assert_close(found, passed[row, column] * sampled, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "recipe",
    [
        {"steps": 3},
        pytest.param({"steps": 3, "support": "edges", "margin": 3}, marks=pytest.mark.slow),
        {"steps": 12, "method": "adam"},
    ],
)
@pytest.mark.usefixtures("no_pictures")
def test_a_stack_on_the_cameras_pixels_is_reconstructed_on_the_volumes_voxels(config, tmp_path, capsys, recipe):
    path = config(pixel_size=24.0, magnification=60.0)
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    values |= {"data": {"path": "simulated/stack.ome.tif", "offset": 100.0}, "reconstruction": recipe}
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    assert main(["simulate", str(path), "--out", str(tmp_path / "simulated"), "--device", "cpu"]) == 0
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    volume, grid = read_volume(tmp_path / "out" / "volume.ome.tif")
    assert grid.spacing == pytest.approx(tuple(values["volume"]["spacing"]))
    assert volume.shape == tuple(values["volume"]["shape"])
    misfits = [float(row.split(",")[1]) for row in (tmp_path / "out" / "log.csv").read_text().splitlines()[1:]]
    assert misfits[-1] < 0.8 * misfits[0]
    assert "its pixels are" not in capsys.readouterr().err  # the file's are the camera's


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_size": 30.0}, "pixels (y × x), the volume of"),
        (
            {"pixel_size": 99.0, "magnification": 9.0},
            "microscope.camera.pixel_size: a pixel of 11 µm doesn't fit into an image of",
        ),
    ],
)
def test_pixels_that_are_not_the_stacks_are_told_with_the_law(config, tmp_path, capsys, changes, message):
    path = config(pixel_size=24.0, magnification=60.0)
    assert main(["simulate", str(path), "--out", str(tmp_path / "simulated"), "--device", "cpu"]) == 0
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    values["microscope"]["camera"] |= changes
    values["data"] = {"path": "simulated/stack.ome.tif"}
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert message in line


@pytest.mark.parametrize("method", ["linear", "opl"])
def test_a_method_that_takes_voxels_alone_says_so(config, tmp_path, method):
    path = config(pixel_size=24.0, magnification=60.0)
    values = tomllib.loads(path.read_text(encoding="utf-8"))
    values |= {"data": {"path": "stack.ome.tif"}, "reconstruction": {"method": method}}
    path.write_text(tomli_w.dumps(values), encoding="utf-8")
    with pytest.raises(ConfigError, match=f"'{method}' takes pixels that are voxels, microscope.camera.pixel_size is"):
        load_data(load(path))


def test_camera_loads_and_is_dumped_again(config, tmp_path):
    loaded = load(config(pixel_size=24.0, magnification=60))
    assert loaded.microscope.camera == Camera(20000.0, 3.0, 0.19, 100.0, 12, 24.0, 60.0)
    again = tmp_path / "again.toml"
    again.write_text(dump(loaded), encoding="utf-8")
    assert load(again).microscope.camera == loaded.microscope.camera
