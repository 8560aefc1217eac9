"""torchdic coverage: which frequencies of Δn an acquisition sees, before it is recorded, and what would add to them."""

import argparse
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from recon.config.reading import load
from recon.config.schema import Config, ConfigError
from recon.coverage.acquisition import NoisyAcquisition, shot_noise
from recon.coverage.changes import Change, changes
from recon.coverage.figure import draw_coverage
from recon.coverage.resolution import Resolution, finest_along_z, resolution_of
from recon.coverage.seen import Coverage
from recon.coverage.shortcoming import shortcoming
from recon.fit.newton.weak_hessian import lacks_of_linear_response
from recon.report import figures
from recon.run.data import empty_levels, load_data
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_no_results
from recon.run.results import leave_configuration
from torchdic.files.whole import write_json
from torchdic.scalar import number

RESULTS = "coverage.json"

# A change, what its images tell, and how wide a point gets in them.
Ranked = tuple[Change, Coverage, Resolution]

# Periods across z, in µm, for which the finest period along z is told.
PERIODS = (0.5, 1.0, 2.0, 4.0)

# A change that adds less than this share of what is seen, or takes less away, is called nothing.
NOTHING = 0.02


def arguments(parser: argparse.ArgumentParser) -> None:
    """What is asked for beside the coverage itself."""
    parser.add_argument(
        "--suggest", action="store_true", help="try single changes of the acquisition, and rank them by what they add"
    )


def run(options: argparse.Namespace) -> None:
    """Print what an acquisition sees, and leave it as coverage.json and coverage.png."""
    check_no_results(options.out, (RESULTS,), restart=options.restart)
    config = load(options.config)
    known = _recording(config, str(options.config))
    if known is None:
        raise ConfigError(f"{options.config}: the stack's noise can't be measured in images so small; give more pixels")
    recording, how = known
    prepare_folder(options.out)
    expected = config.coverage
    found = recording.coverage(expected)
    resolution = resolution_of(found)
    print(_words(found, resolution, recording, how))
    ranked: list[Ranked] = []
    if options.suggest:
        tried = list(changes(recording))
        covered = [change.recording.coverage(expected) for change in tqdm(tried, desc="changes", unit="change")]
        widths = map(resolution_of, covered)
        ranked = sorted(zip(tried, covered, widths, strict=True), key=lambda one: -one[1].number)
        print("\n" + "\n".join(_suggestions(found, ranked)))
    figures.save(draw_coverage(found, _axis(config)), options.out / "coverage.png")
    write_json(options.out / RESULTS, _as_dict(found, resolution, recording, ranked))
    leave_configuration(config, options.out, "coverage")
    print(f"\n{options.out / RESULTS} and coverage.png")


def _recording(config: Config, source: str) -> tuple[NoisyAcquisition, str] | None:
    """The recording that a configuration plans or names, and where its noise is from.

    None where the images are too small to tell it. Raises ConfigError where nothing tells it, or they show nothing.
    """
    lacking = lacks_of_linear_response(config.microscope, config.acquisition)
    if lacking is not None:
        raise ConfigError(f"{source}: these images show nothing of a weak specimen: they need {lacking}")
    camera, photons = config.microscope.camera, _photons(config)
    if config.data is not None and (_recorded(config) or photons is None):
        noise, how = load_data(config).noise, "measured in the stack"
        if noise is None:
            return None
    elif camera is not None and photons is not None:
        levels, how = empty_levels(config), f"of {photons:g} photons per pixel of the bright field"
        noise = [shot_noise(level, photons, camera.read_noise or 0.0) for level in levels]
    else:
        raise ConfigError(
            f"{source}: missing key microscope.camera.photons or data.path: what images tell depends on their noise"
        )
    grid, background = config.volume.grid, config.volume.background
    return NoisyAcquisition(grid, background, config.microscope, config.acquisition, tuple(noise)), how


def _recorded(config: Config) -> bool:
    """Whether there is a stack, whose noise can be measured."""
    return config.data is not None and all(Path(file).exists() for file in config.data.files)


def _photons(config: Config) -> float | None:
    """Photons per pixel of the bright field, where they are known."""
    return None if config.microscope.camera is None else config.microscope.camera.photons


def in_short(config: Config, source: str) -> str | None:
    """What images of a configuration would tell, in one line; None where nothing tells their noise."""
    if not (_recorded(config) or _photons(config)):
        return None
    if lacks_of_linear_response(config.microscope, config.acquisition) is not None:
        return None
    if (known := _recording(config, source)) is None:
        return None
    found = known[0].coverage(config.coverage, roughly=True)
    resolution = resolution_of(found)
    point = f"a point's width {_widths(found, resolution)}"
    told = f"seen: {found.share:.0%} of the frequencies; {point} (torchdic coverage tells more)"
    lacks = shortcoming(found)
    return told if lacks is None else f"{told}\n{lacks}"


def _words(found: Coverage, resolution: Resolution, recording: NoisyAcquisition, how: str) -> str:
    """What was found, a line each."""
    noise = sorted({f"{100 * level:.2g}" for level in recording.noise}, key=float)
    rows = [
        ("images", f"{len(recording.acquisition.prisms)} prism settings × {len(recording.focus)} planes"),
        ("noise", f"{' to '.join(noise[:: max(1, len(noise) - 1)])} % of the bright field, {how}"),
        ("seen", f"{found.share:.0%} of the frequencies that the apertures let through"),
        ("a point's width", _widths(found, resolution)),
        ("Δn", f"known to ± {found.deviation:.2g}, before it ± {found.known_before:.2g}"),
    ]
    for period in PERIODS:
        along = finest_along_z(found, period)
        rows.append((f"{period:g} µm across z", _seen(along)))
    width = max(len(name) for name, _ in rows)
    lines = [f"  {name:<{width}}  {words}" for name, words in rows]
    lines.append(shortcoming(found) or "")
    return "\n".join(lines).rstrip()


def _widths(found: Coverage, resolution: Resolution) -> str:
    """How wide a point gets across and along z."""
    return f"{_across(found, resolution)}, {_along(found, resolution)} along z"


def _along(found: Coverage, resolution: Resolution) -> str:
    """How wide a point gets along z."""
    return _within(resolution.axial, found.grid.extent[0])


def _across(found: Coverage, resolution: Resolution) -> str:
    """How wide a point gets across z."""
    side = min(found.grid.extent[1:])
    finest, coarsest = (_within(width, side) for width in (resolution.finest, resolution.coarsest))
    worst = "" if finest == coarsest else f" ({coarsest} along {resolution.direction:g}°)"
    return f"{finest} across z{worst}"


def _within(width: float, most: float) -> str:
    """A width in words: none is told beyond the volume's, which is `most`."""
    return f"more than the volume's {most:.2g} µm" if math.isinf(width) else f"{width:.2g} µm"


def _seen(along: float | None) -> str:
    """What is seen of gratings whose shortest period along z is `along`; see `finest_along_z`."""
    if along is None:
        return "isn't seen"
    if math.isinf(along):
        return "is seen where it doesn't change along z"
    return f"is seen where it changes along z with periods of {along:.2g} µm or more"


def _suggestions(found: Coverage, ranked: list[Ranked]) -> list[str]:
    """What each change adds to what is seen, the most first."""
    lines = ["single changes, by what they add to the frequencies that are seen:"]
    for change, other, resolution in ranked:
        gain = other.number / found.number - 1
        images = "" if math.isclose(change.images, 1) else f", {change.images:.3g} × the images"
        adds = "next to nothing" if abs(gain) < NOTHING else f"{gain:+.0%}".replace("-", "−")
        lines.append(
            f"  {adds:>15}  {change.name}: {_along(other, resolution)} along z, Δn ± {other.deviation:.2g}{images}"
        )
    return lines


def _axis(config: Config) -> float:
    """The first shear's axis, from right towards down, in rad; 0 in bright field."""
    for prism in config.acquisition.prisms:
        if prism is not None:
            y, x = (number(part) for part in prism.shear)
            return math.atan2(y, x)
    return 0.0


def _as_dict(
    found: Coverage, resolution: Resolution, recording: NoisyAcquisition, ranked: list[Ranked]
) -> dict[str, Any]:
    """What was found as values that JSON can hold; what is infinite is None."""

    def of(covered: Coverage, widths: Resolution) -> dict[str, Any]:
        sizes = {name: value if math.isfinite(value) else None for name, value in asdict(widths).items()}
        return {
            "seen_share": covered.share,
            "seen_number": covered.number,
            "deviation": covered.deviation,
            "deviation_before": covered.known_before,
            "point_width_um": sizes,
        }

    along = {f"{period:g}": finest_along_z(found, period) for period in PERIODS}
    return {
        **of(found, resolution),
        "finest_period_along_z_um": {name: value for name, value in along.items() if value != math.inf},
        "noise": list(recording.noise),
        "changes": [
            {"change": change.name, "images": change.images, **of(other, widths)} for change, other, widths in ranked
        ],
    }
