"""report.html: what it says is what the files hold, and what they don't hold it says, too."""

import base64
import errno
import json
import os
import re
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from lxml import html
from results_folder import GRID, METRICS, VERDICT, images, leave_results, volume
from small_bead import CONFIG

from recon.cli import main
from recon.report.html.folder import Folder
from recon.report.html.headline import KINDS, kind_of
from recon.report.html.packed import LEVELS, Thinning, in_levels, reach
from recon.report.html.page import leave_report, page
from recon.report.html.plots import spectrum
from recon.report.html.surface import STEPS, surfaces
from recon.report.html.words import duration, short, size, sure
from torchdic import Grid
from torchdic.files.stack import write_stack, write_volume

BYTES_OF_PAGE = 15e6


@pytest.fixture(autouse=True)
def _no_curves(request, monkeypatch):
    """Curves are left out: most of the time of a page is Matplotlib's."""
    if "curves" not in request.fixturenames:
        monkeypatch.setattr("recon.report.html.plots.as_svg", lambda _figure, name: f"<svg id='{name}'></svg>")


@pytest.fixture
def curves():
    """Curves are drawn."""


def unpacked(text: str, dtype=np.uint8) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype)


@pytest.fixture
def results(tmp_path):
    leave_results(tmp_path)
    return tmp_path


def text_of(out: Path) -> str:
    """The page of a folder as a reader has it."""
    tree = html.fromstring(page(Folder(out), kind_of(Folder(out))))
    return " ".join(" ".join(tree.xpath("//body//text()[not(parent::script)]")).split())


def data_of(out: Path) -> dict:
    tree = html.fromstring(page(Folder(out), kind_of(Folder(out))))
    return json.loads(tree.get_element_by_id("data").text)


# --- what the page holds ----------------------------------------------------------------------------------------------


def test_levels_err_by_half_a_step_at_most():
    values = np.random.default_rng(0).uniform(-0.02, 0.05, (5, 7))
    levels = in_levels(values, -0.02, 0.05)
    assert np.abs(levels / LEVELS * 0.07 - 0.02 - values).max() <= 0.5 * 0.07 / LEVELS * (1 + 1e-12)
    assert in_levels(np.array([-1.0, 1.0]), 0.0, 0.5).tolist() == [0, LEVELS]
    assert in_levels(np.zeros(2), 0.0, 0.0).tolist() == [0, 0]


def test_the_page_holds_the_volume_and_the_images_to_half_a_level(results):
    data = data_of(results)
    (shown,) = data["volumes"]
    delta = volume().numpy()
    levels = unpacked(shown["values"]).reshape(GRID.shape).astype(float)
    assert np.abs(levels / LEVELS * shown["high"] - delta).max() <= 0.51 * delta.max() / LEVELS
    assert shown["places"][2] == pytest.approx(GRID.coordinates(2, dtype=torch.float64).tolist(), abs=1e-6)
    measured, modelled = images()
    for kind, stack in zip(data["images"]["kinds"], (measured, modelled, measured - modelled), strict=True):
        levels = unpacked(kind["values"]).reshape(stack.shape).astype(float)
        for p, (low, high) in enumerate(kind["limits"]):
            within = np.clip(stack[p], low, high)
            assert np.abs(low + levels[p] / LEVELS * (high - low) - within).max() <= 0.51 * (high - low) / LEVELS
    rms = np.sqrt(((measured - modelled) ** 2).mean((2, 3)))
    assert np.array(data["images"]["rms"]) == pytest.approx(rms, rel=1e-3)


def test_thinning_takes_means_of_blocks_cut_off_at_the_ends():
    values = np.random.default_rng(0).random((5, 7, 4))
    thin = Thinning((2, 3, 1)).of(values)
    assert thin.shape == (3, 3, 4)
    assert thin[1, 2] == pytest.approx(values[2:4, 6:].mean((0, 1)))
    assert thin[2, 0] == pytest.approx(values[4:, :3].mean((0, 1)))
    assert Thinning((2, 3, 1)).places(1, 7, 0.5) == pytest.approx([-1.0, 0.5, 1.5])
    assert Thinning((1, 1, 1)).of(values) is values


@pytest.mark.parametrize("shape", [(20, 96, 96), (64, 512, 512), (1, 3000, 10), (700, 1, 1)])
def test_thinned_volumes_are_within_what_is_allowed_and_no_coarser_than_need_be(shape):
    spacing = (0.4, 0.2, 0.1)
    blocks = Thinning.within(10_000, shape, spacing).blocks
    left = [-(-n // block) for n, block in zip(shape, blocks, strict=True)]
    assert np.prod(left) <= 10_000
    assert np.prod(left) >= 2_500 or np.prod(shape) <= 10_000
    sizes = [block * d for block, d, n in zip(blocks, spacing, shape, strict=True) if 1 < block < n]
    assert max(sizes, default=1) <= 2 * min(sizes, default=1)  # voxels become more alike along the axes


def test_a_few_voxels_that_stand_out_do_not_decide_the_scale():
    values = np.full((20, 40, 40), 0.02)
    values[0, 0, :5] = 0.5
    assert reach(values) == (0.0, 0.02)
    assert reach(-values) == (-0.02, 0.0)
    lonely = np.zeros((20, 40, 40))
    lonely[3, 4, 5] = 0.1
    assert reach(lonely) == (0.0, 0.1)


def test_a_large_volume_is_thinned_and_the_page_says_so(results, monkeypatch):
    monkeypatch.setattr("recon.report.html.volumes.MOST_VOXELS", 300)
    monkeypatch.setattr("recon.report.html.images.MOST_PIXELS", 900)
    monkeypatch.setattr("recon.report.html.images.LEAST_PIXELS", 60)
    data, text = data_of(results), text_of(results)
    assert np.prod(data["volumes"][0]["shape"]) <= 300
    assert "the sections are thinned to means of" in text
    assert len(data["images"]["planes"]) * np.prod(data["images"]["size"]) * 6 <= 900
    assert "the images are thinned to" in text


def test_a_page_of_20_x_96_x_96_voxels_is_below_15_megabytes(tmp_path):
    """Even where nothing can be packed: noise everywhere, and surfaces all over the volume."""
    grid = Grid((20, 96, 96), (0.4, 0.17, 0.17))
    random = torch.Generator().manual_seed(0)
    write_volume(tmp_path / "volume.ome.tif", torch.randn(grid.shape, generator=random), grid)
    write_volume(tmp_path / "sd.ome.tif", torch.rand(grid.shape, generator=random), grid)
    write_stack(tmp_path / "images.ome.tif", torch.randn(8, 9, 96, 96, generator=random), grid.spacing[1:], 1.0)
    assert leave_report(tmp_path).stat().st_size < BYTES_OF_PAGE


@pytest.mark.slow
def test_a_page_of_a_large_volume_is_below_15_megabytes(tmp_path):
    grid = Grid((64, 320, 320), (0.4, 0.17, 0.17))
    random = torch.Generator().manual_seed(0)
    write_volume(tmp_path / "volume.ome.tif", torch.randn(grid.shape, generator=random), grid)
    assert leave_report(tmp_path).stat().st_size < BYTES_OF_PAGE


# --- surfaces and spectra ---------------------------------------------------------------------------------------------


def test_the_surface_of_a_ball_lies_on_it_and_encloses_it():
    """Off the centre, on unequal voxels, so that swapped axes would show."""
    grid, centre, radius = Grid((24, 30, 40), (0.3, 0.25, 0.2)), (0.4, -0.7, 1.1), 2.0
    axes = np.meshgrid(*(grid.coordinates(axis, dtype=torch.float64).numpy() for axis in range(3)), indexing="ij")
    distance = np.sqrt(sum((axis - place) ** 2 for axis, place in zip(axes, centre, strict=True)))
    found = surfaces(0.02 * np.exp(-((distance / radius) ** 2) * np.log(2)), grid)
    half = found.levels[found.first]
    radius *= np.sqrt(np.log2(0.02 / half["level"]))  # where the level is reached
    assert half["inside"] == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.03)
    (mesh,) = half["meshes"]
    steps = unpacked(mesh["vertices"], "<u2").reshape(-1, 3)
    places = (np.cumsum(steps, axis=0, dtype="<u2") / STEPS - 0.5) * np.array(found.size)
    away = np.linalg.norm(places - np.array(centre[::-1]), axis=1)
    assert np.abs(away - radius).max() < 0.1 * min(grid.spacing)
    faces = np.cumsum(unpacked(mesh["faces"], "<u4"), dtype="<u4")
    assert sorted(set(faces)) == list(range(len(places)))


def test_a_volume_of_both_signs_has_surfaces_of_both():
    delta = np.zeros((6, 8, 8))
    delta[1:3, 2:5, 2:5], delta[3:5, 5:7, 5:7] = 0.02, -0.02
    found = surfaces(delta, Grid((6, 8, 8), (1.0, 1.0, 1.0)))
    assert [mesh["sign"] for mesh in found.levels[0]["meshes"]] == [1, -1]
    assert found.levels[0]["inside"] == 2 * 3 * 3 + 2 * 2 * 2
    assert surfaces(np.zeros((2, 3, 3)), Grid((2, 3, 3), (1.0, 1.0, 1.0))) is None


def test_white_noise_has_the_same_power_at_all_frequencies():
    noise = 0.3 * np.random.default_rng(0).standard_normal((40, 60, 50))
    frequency, power = spectrum(noise, (0.2, 0.25))
    assert 1.9 < frequency.max() <= 2.0  # of the coarser pixels
    # each ring holds some 40 images × 30 or more waves, whose power has a standard deviation of 1
    assert np.abs(power[2:] / 0.09 - 1).max() < 6 / np.sqrt(40 * 10)
    assert power.mean() == pytest.approx(0.09, rel=0.05)


def test_a_grating_shows_at_its_frequency():
    x = np.arange(80) * 0.25
    frequency, power = spectrum(np.broadcast_to(np.sin(2 * np.pi * 0.5 * x), (1, 64, 80)), (0.25, 0.25))
    assert frequency[power.argmax()] == pytest.approx(0.5, abs=2 / 32)
    assert np.sort(power)[-2] < 1e-3 * power.max()


# --- words ------------------------------------------------------------------------------------------------------------


def test_numbers_are_said_with_the_digits_that_they_are_known_to():
    assert sure(142.123, 5.31) == "142.1 ± 5.3"
    assert sure(1.3574576, 0.000355) == "1.35746 ± 0.00035" or sure(1.3574576, 0.000355) == "1.35746 ± 0.00036"
    assert short(-0.0) == "0"
    assert short(-0.01234) == "−0.0123"
    assert short(1.2e-7) == "1.20 × 10⁻⁷"
    assert [short(n) for n in (999.7, -999.7, 99.96, 1234.4)] == ["1000", "−1000", "100", "1234"]
    assert short(float("nan")) == short(None) == "–"
    assert [duration(s) for s in (0.42, 42, 200, 7500)] == ["0.42 s", "42 s", "3 min 20 s", "2 h 5 min"]
    assert [duration(s) for s in (3e-5, 9.97, 59.7, 3599.8)] == ["3.0 × 10⁻⁵ s", "10 s", "1 min 0 s", "1 h 0 min"]
    assert [size(n) for n in (900, 3.1e8, 9.999e8)] == ["900 bytes", "310 MB", "1000 MB"]


def test_the_verdict_stands_first_and_the_numbers_have_units(results):
    text = text_of(results)
    first = text.index("The volume explains the stack")
    for words in ("Misfit 0.1 is 1.020 × what noise leaves", "5 × 12 × 16 voxels of 0.5 × 0.25 × 0.2 µm", "1 min 15 s"):
        assert first < text.index(words) < text.index("Three sections through one point")
    assert "shear 0.2 µm towards 0°, bias 90°" in json.dumps(data_of(results), ensure_ascii=False)
    assert "2 of 2: bright field" in json.dumps(data_of(results))
    assert "torchdic reconstruct run.toml" in text
    assert "310 MB" in text


def test_a_poor_fit_is_told_in_plain_words_with_its_causes(results):
    cause = {"name": "focus", "share": 0.9, "reason": "a short fit explains 90 %", "advice": "reverse the planes"}
    words = "misfit 0.5 is 5.000 × what noise leaves (0.1): 40% of the contrast is unexplained; most likely: focus"
    poor = VERDICT | {"poor": True, "causes": [cause], "words": words}
    (results / "metrics.json").write_text(json.dumps(METRICS | {"verdict": poor}), encoding="utf-8")
    text = text_of(results)
    assert "The volume does not explain the images" in text
    assert "Focus (a short fit explains 90 %): reverse the planes." in text


# --- what is missing or damaged ---------------------------------------------------------------------------------------

FILES = ("images.ome.tif", "metrics.json", "log.csv", "config.resolved.toml", "run.json")


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_leaves_out_what_it_would_show_with_a_word(results, name):
    (results / name).unlink()
    text = text_of(results)
    assert f"{name} is not in this folder" in text
    assert "Three sections through one point" in text
    assert ("Plane" in text) == (name != "images.ome.tif")


@pytest.mark.parametrize("name", [*FILES, "volume.ome.tif", "error_bars.json", "coverage.json", "calibration.json"])
@pytest.mark.parametrize("damage", [b"", b"\xff\xfe\x00garbage", b"[1, 2"], ids=["empty", "bytes", "broken"])
def test_a_damaged_file_is_named_and_costs_no_more(results, name, damage):
    (results / name).write_bytes(damage)
    text = text_of(results)
    # of a log the first line is its head, and a configuration may be empty
    assert f"{name}: " in text or (damage != b"\xff\xfe\x00garbage" and name in ("log.csv", "config.resolved.toml"))
    assert "How it was made" in text


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("metrics.json", "[" * 100_000),
        ("log.csv", "step\n1\n2\n"),
        ("log.csv", f"step,misfit\n{'1' * 200_000},2\n"),
        ("comparison.json", "{}"),
    ],
    ids=["too deep", "one column", "an endless number", "no list"],
)
def test_a_file_of_the_right_kind_but_no_use_is_named_too(results, name, damage):
    (results / name).write_text(damage)
    assert f"{name}: " in text_of(results)


def test_images_that_are_no_pairs_are_named(results):
    write_stack(results / "images.ome.tif", images()[0][:1], GRID.spacing[1:], 1.0)
    assert "images.ome.tif: holds 1 channels, no measured and modelled ones in turn" in text_of(results)


def test_the_page_of_a_folder_has_its_name_wherever_one_stands(results, monkeypatch):
    (results / "below").mkdir()
    monkeypatch.chdir(results / "below")
    assert Folder(Path("..")).name == results.name


def test_a_name_that_is_no_utf_8_loses_no_page(tmp_path):
    """As other encodings leave names on Linux."""
    out = tmp_path / os.fsdecode(b"caf\xe9")
    try:
        out.mkdir()
    except OSError:
        pytest.skip("this file system has names in UTF-8 alone")
    leave_results(out)
    assert "caf?" in leave_report(out).read_text(encoding="utf-8")


# Values of other kinds than are expected, as JSON may hold them.
ODD = (None, "word", [3.0, [None]], [{"a": 3.0}], {"a": [3.0], "specimen": {"a": "word"}})


@pytest.mark.parametrize("name", ["metrics.json", "error_bars.json", "coverage.json", "calibration.json", "plan.json"])
def test_numbers_of_another_version_lose_no_page(results, name):
    keys = [*METRICS, *VERDICT, "regions", "inside_and_near", "point_width_um", "changes", "effects"]
    for value in ODD:
        (results / name).write_text(json.dumps(dict.fromkeys(keys, value)), encoding="utf-8")
        assert "Three sections through one point" in text_of(results)


def test_what_should_be_words_and_is_not_is_left_out(results):
    (results / "metrics.json").write_text(json.dumps(METRICS | {"seen": {"lacks": 5}}), encoding="utf-8")
    assert "The volume explains the stack" in text_of(results)


def test_error_bars_of_an_earlier_volume_are_said_to_be(results):
    write_volume(results / "sd.ome.tif", volume() / 10, GRID)
    numbers = {"volume_um3": {"value": 142.1, "error": 5.3}}
    (results / "error_bars.json").write_text(json.dumps({"regions": {"specimen": numbers}}), encoding="utf-8")
    assert text_of(results).count("142.1 ± 5.3") == 2  # among the first numbers, and in the table
    for name in ("sd.ome.tif", "error_bars.json"):
        os.utime(results / name, (1, 1))
    text = text_of(results)
    assert "Error bars of an earlier volume" in text
    assert "± by noise (of an earlier volume)" in text
    assert text.count("142.1 ± 5.3") == 1


def test_text_of_the_users_is_text_on_the_page(results):
    wicked = "</script></pre><script>alert(1)</script>"
    (results / "config.resolved.toml").write_text(f'note = "{wicked}"', encoding="utf-8")
    metrics = METRICS | {"verdict": VERDICT | {"words": f"misfit: {wicked}"}}
    (results / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    assert "<script>alert" not in page(Folder(results), kind_of(Folder(results)))


# --- a page that anyone can use, and that loads nothing ---------------------------------------------------------------


def test_the_page_loads_nothing_and_each_part_has_a_name(results, curves):
    source = page(Folder(results), kind_of(Folder(results)))
    tree = html.fromstring(source)
    assert not [link for link in tree.xpath("//@src | //link/@href") if not link.startswith("data:")]
    assert "default-src 'none'" in source
    assert not re.search(r"url\(\s*['\"]?https?:", source)
    ids = tree.xpath("//@id")
    assert len(ids) == len(set(ids))
    labelled = set(tree.xpath("//label/@for"))
    for control in tree.xpath("//input | //select"):
        assert control.get("id") in labelled or control.getparent().tag == "label"
    assert all(picture.get("alt") for picture in tree.xpath("//img"))
    assert all(name in ids for name in tree.xpath("//@aria-labelledby"))
    assert all(link.removeprefix("#") in ids for link in tree.xpath("//a/@href"))
    levels = [int(heading.tag[1]) for heading in tree.xpath("//h1 | //h2 | //h3")]
    assert levels[0] == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert tree.get("lang") == "en"


# --- commands ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def bead(tmp_path, monkeypatch, no_pictures):
    monkeypatch.setattr("recon.cli.running.leave_report", leave_report)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bead.toml").write_text(CONFIG)
    return tmp_path


def test_each_command_leaves_a_report_that_is_made_again_alike(bead, capsys):
    assert main(["simulate", "bead.toml", "--out", "made"]) == 0
    first = (bead / "made" / "report.html").read_text(encoding="utf-8")
    record = json.loads((bead / "made" / "run.json").read_text(encoding="utf-8"))["simulate"]
    assert record["command"] == "torchdic simulate bead.toml --out made"
    assert record["seconds"] > 0
    assert record["peak_bytes"] > 5e7
    assert record["versions"]["torch"] == torch.__version__
    capsys.readouterr()
    assert main(["report", "made"]) == 0
    assert capsys.readouterr().out.startswith("made/report.html: 0.")
    again = (bead / "made" / "report.html").read_text(encoding="utf-8")
    without_time = [re.sub(r"on \d{4}-\d\d-\d\d \d\d:\d\d from", "", text) for text in (first, again)]
    assert without_time[0] == without_time[1]
    assert list(json.loads((bead / "made" / "run.json").read_text(encoding="utf-8"))) == ["simulate"]


def test_a_report_without_room_costs_itself_alone(bead, monkeypatch, capsys):
    replace = Path.replace

    def fails(path, target):
        if Path(target).name == "report.html":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", fails)
    assert main(["simulate", "bead.toml", "--out", "made"]) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("torchdic: error"))
    told = "made/report.html: cannot be written: No space left on device; make room, and torchdic report made makes it"
    assert line == f"torchdic: error: {told}"
    left = {path.name for path in (bead / "made").iterdir()}
    assert left == {"stack.ome.tif", "stack.png", "config.resolved.toml", "run.json", "README.txt"}


@pytest.mark.filterwarnings("default")
def test_files_of_the_users_stay(bead, capsys):
    (bead / "made").mkdir()
    (bead / "made" / "report.html").write_text("<p>my own</p>")
    (bead / "made" / "run.json").write_text('{"mine": 1}')
    assert main(["simulate", "bead.toml", "--out", "made"]) == 0
    assert "made/report.html: isn't torchdic's" in capsys.readouterr().err
    assert main(["report", "made"]) == 2
    assert "move it away" in capsys.readouterr().err
    assert (bead / "made" / "report.html").read_text() == "<p>my own</p>"
    assert (bead / "made" / "run.json").read_text() == '{"mine": 1}'


@pytest.mark.parametrize(
    ("folder", "words"),
    [("missing", "there is no such folder"), ("bead.toml", "is no folder"), (".", "holds no results of torchdic")],
)
def test_a_report_of_nothing_is_refused_in_a_line(bead, capsys, folder, words):
    assert main(["report", folder]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"torchdic: error: {folder}: {words}")
    assert not (bead / "report.html").exists()


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_folder_has_a_page(tmp_path, name):
    """From one file alone, which may hold nothing that can be shown."""
    (tmp_path / name).write_text("[]" if name.endswith(".json") else "")
    assert KINDS[name][0] in text_of(tmp_path)
