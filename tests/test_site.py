"""The site's sources: the reference holds everything, links lead somewhere, blocks of code can be used."""

import dataclasses
import re
import runpy
import sys
from pathlib import Path

import pytest

import data_synthetic
import recon
import torchdic
from recon.cli.commands import COMMANDS
from recon.config.conversion import FIELDS, flat
from recon.config.reading import load
from recon.config.schema import Config

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))

from generator import blocks, commands, docstrings, gallery, keys, names  # noqa: E402

# Made with the site.
MADE = ("generated/", "gallery/")


def test_every_key_of_a_resolved_configuration_is_in_the_reference():
    told = {path.replace("[]", "") for path in keys.paths()}
    for experiment in (ROOT / "experiments").glob("*.toml"):
        for line in flat(load(experiment)):
            key = re.sub(r"\[\d+\]", "", line.split(" = ")[0])
            if not key.startswith("specimen."):
                assert key in told


def test_every_key_of_a_section_is_in_the_reference():
    made = [field.default_factory for field in dataclasses.fields(Config)]
    sections = {*FIELDS, *(type(make()) for make in made if make is not dataclasses.MISSING)}
    page = keys.page()
    for section in sections - {tuple}:
        for field in dataclasses.fields(section):
            assert f"| `{field.name}` |" in page


def test_every_key_has_a_type_a_default_and_a_meaning():
    lacking = [
        (table.path, key)
        for table in keys.tables()
        for key in table.keys
        if not (key.type and key.default and key.meaning)
    ]
    assert lacking == []


def test_keys_have_the_units_of_their_docstrings():
    units = {f"{table.path}.{key.name}": key.unit for table in keys.tables() for key in table.keys}
    assert units["volume.spacing"] == units["microscope.wavelength"] == "µm"
    assert units["acquisition.prisms[].bias"] == units["calibration.angle_within"] == "rad"
    assert units["fidelity.memory"] == "bytes"
    assert units["calibration.length_within"] == units["microscope.objective.na"] == ""


def test_every_command_and_option_is_in_the_reference():
    page = commands.page()
    for name, command in COMMANDS.items():
        section = page.split(f"## `torchdic {name}`\n")[1].split("\n## ")[0]
        for option in commands.parser(name, command)._option_string_actions:
            assert f"`{option}" in section


def test_every_public_name_is_in_the_reference():
    page = names.page()
    for package in (torchdic, recon, data_synthetic):
        for name in package.__all__:
            assert re.search(rf"^\.\. auto\w+:: {package.__name__}\.{name}$", page, re.MULTILINE)


def test_a_docstring_is_read_in_its_parts():
    text = (
        "A prism.\n\nshear: (y, x) in µm,\n    full. bias: in rad.\nlow, high: bounds.\nRaises ValueError for 0: never."
    )
    read = docstrings.read(text, ["shear", "bias", "low", "high", "other"])
    assert read.meanings == {"shear": "(y, x) in µm, full.", "bias": "in rad.", "low": "bounds.", "high": "bounds."}
    assert read.text == ["A prism.", "Raises ValueError for 0: never."]
    assert docstrings.raised(text) == "Raises ValueError for 0: never."


@pytest.mark.parametrize("page", blocks.PAGES, ids=lambda page: page.stem)
def test_links_within_the_repository_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?:|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        file = page.parent / name if name else page
        made = file.resolve().relative_to(ROOT).as_posix().removeprefix("docs/").startswith(MADE)
        assert made or file.exists(), target
        if anchor and not made:
            assert anchor in anchors(file), target


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as a code host makes them, and as MyST does."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", blocks.PAGES, ids=lambda page: page.stem)
def test_blocks_of_code_can_be_used(page):
    blocks.check(page)


@pytest.mark.parametrize(
    ("language", "block"),
    [
        ("sh", "torchdic recontruct run.toml"),
        ("sh", "torchdic reconstruct run.toml --outt DIR"),
        ("sh", "make nothing"),
        ("sh", "python experiments/nothing.py"),
        ("sh", "pip install 'torchdic[nothing]'"),
        ("toml", "a = "),
        ("python", "a = "),
    ],
)
def test_a_block_that_cannot_be_used_is_refused(language, block, tmp_path):
    page = tmp_path / "nothing.md"
    page.write_text(f"```{language}\n{block}\n```\n", encoding="utf-8")
    with pytest.raises(blocks.BlockError, match=r"nothing\.md"):
        blocks.check(page)


SCRIPTS = sorted(gallery.SCRIPTS.glob("*.py"))
MOST_LINES = 40


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_of_the_gallery_has_at_most_40_lines(script):
    lines = len(script.read_text(encoding="utf-8").splitlines())
    assert lines <= MOST_LINES, f"{script.name}: {lines} lines"


def test_every_script_of_the_gallery_is_listed_as_a_picture_and_in_the_same_order_as_a_page():
    pictures = re.findall(r"^   \.\./experiments/gallery/(\w+)\.py$", gallery.PAGE, re.MULTILINE)
    pages = re.findall(r"^   (\w+)$", gallery.PAGE, re.MULTILINE)
    assert pictures == pages
    assert sorted(pictures) == [script.stem for script in SCRIPTS]
    assert sorted(SCRIPTS, key=gallery.place) == [gallery.SCRIPTS / f"{name}.py" for name in pictures]


def test_scripts_of_measured_data_run_where_there_are_some():
    run = {data: {s.stem for s in SCRIPTS if re.search(gallery.runs(data), str(s))} for data in (None, "data")}
    assert run["data"] == {script.stem for script in SCRIPTS}
    assert run["data"] - run[None] == {"agar_beads", "hl60"}


@pytest.mark.parametrize("name", ["agar_beads", "hl60"])
def test_a_script_without_its_measured_data_says_so(name, monkeypatch):
    monkeypatch.delenv("TORCHDIC_DATA", raising=False)
    with pytest.raises(SystemExit, match=rf"^{name}\.py: TORCHDIC_DATA must name the folder"):
        runpy.run_path(str(gallery.SCRIPTS / f"{name}.py"))
