import math

import pytest
import torch

from torchdic import Camera


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
    ],
)
def test_an_unphysical_camera_is_refused(values, law):
    with pytest.raises(ValueError, match=law):
        Camera(**values)
