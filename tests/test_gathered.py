"""A stack in several files, and what files say of their microscope."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from torchdic.errors import StackError, StackWarning
from torchdic.files.described.setup import setup_in_words
from torchdic.files.gathered import gather
from torchdic.files.stack import read_stack, write_stack

STACK = np.arange(2 * 12 * 5 * 6, dtype=np.uint16).reshape(2, 12, 5, 6) + 7


def planes(folder, name, data=STACK):
    """A file for each plane; name: of the file, from the setting and the plane."""
    folder.mkdir(exist_ok=True)
    for setting, images in enumerate(data):
        for plane, image in enumerate(images):
            tifffile.imwrite(folder / name(setting, plane), image, photometric="minisblack", metadata=None)
    return folder


# --- several files ----------------------------------------------------------------------------------------------------

NAMES = {
    "c and z": lambda s, p: f"img_c{s}_z{p}.tif",
    "z before channel": lambda s, p: f"z{p}ch{s}.tif",
    "words": lambda s, p: f"{('minus', 'plus')[s]}_{p + 1}.tif",
    "micro-manager": lambda s, p: f"img_channel{s:03}_position000_time000000000_z{p:03}.tif",
    "w of MetaMorph": lambda s, p: f"cell_w{s + 1}_t{p}.tif",
}


@pytest.mark.parametrize("name", NAMES)
def test_settings_and_planes_are_found_in_the_names(tmp_path, name):
    gathered = gather([planes(tmp_path / "planes", NAMES[name])])
    assert np.array_equal(gathered.stack.data, STACK)
    assert len(gathered.files) == 24


def test_planes_come_in_the_natural_order_of_their_names(tmp_path):
    """Plane 2 before plane 10, in a folder or typed in any order."""
    folder = planes(tmp_path / "planes", lambda _, p: f"plane {p}.tif", STACK[:1])
    assert np.array_equal(gather([folder]).stack.data, STACK[:1])
    assert np.array_equal(gather(sorted(folder.iterdir(), reverse=True)).stack.data, STACK[:1])


def test_files_of_several_planes_are_a_setting_each(tmp_path):
    for setting, images in enumerate(STACK):
        write_stack(tmp_path / f"bias{setting}.ome.tif", images, (0.1, 0.1), 0.5)
    stack = gather(sorted(tmp_path.iterdir())).stack
    assert np.array_equal(stack.data, STACK)
    assert (stack.pixel_size, stack.focus_step) == ((0.1, 0.1), 0.5)


def test_settings_are_in_the_order_typed(tmp_path):
    """Planes stay in the order of their numbers."""
    for name, images in zip(("b_plus", "a_minus"), STACK, strict=True):
        write_stack(tmp_path / f"{name}.tif", images, (0.1, 0.1), 0.5)
    stack = gather([tmp_path / "b_plus.tif", tmp_path / "a_minus.tif"]).stack
    assert np.array_equal(stack.data, STACK)
    assert stack.names == ("b_plus.tif", "a_minus.tif")
    assert stack.source == f"{tmp_path / 'b_plus.tif'} and {tmp_path / 'a_minus.tif'}"
    assert gather([tmp_path]).stack.names == ("a_minus.tif", "b_plus.tif")
    folder = planes(tmp_path / "planes", lambda s, p: f"{('plus', 'minus')[s]}_{p + 1}.tif")
    stack = gather(sorted(folder.iterdir(), reverse=True)).stack
    assert np.array_equal(stack.data, STACK)
    assert stack.names == ("plus_1.tif to plus_12.tif", "minus_1.tif to minus_12.tif")
    pair = planes(tmp_path / "pair", lambda s, _: f"cell {('plus', 'minus')[s]}.tif", STACK[:, :1])
    stack = gather([pair / "cell plus.tif", pair / "cell minus.tif"]).stack
    assert np.array_equal(stack.data, STACK[:, :1])


def test_a_file_that_is_named_twice_is_refused(tmp_path, monkeypatch):
    write_stack(tmp_path / "a.tif", STACK[:1], (0.1, 0.1), 0.5)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        StackError, match=r"a\.tif: is named twice; each file is a prism setting, or a plane, of its own"
    ):
        gather([Path("a.tif"), tmp_path / "a.tif"])


def test_a_link_to_itself_is_no_file(tmp_path):
    link = tmp_path / "a.tif"
    link.symlink_to("a.tif")
    with pytest.raises(StackError, match=r"a\.tif: cannot be opened: Too many levels of symbolic links"):
        gather([link])


def test_one_file_is_read_as_it_is(tmp_path):
    write_stack(tmp_path / "one.ome.tif", STACK, (0.1, 0.1), 0.5, bits=12)
    gathered = gather([tmp_path / "one.ome.tif"])
    assert gathered.one_file
    assert np.array_equal(gathered.stack.data, STACK)
    assert gathered.stack.bits == read_stack(tmp_path / "one.ome.tif").bits == 12
    assert np.array_equal(gather([tmp_path]).stack.data, STACK)  # a folder that holds it alone


def test_micro_managers_metadata_give_sizes_and_bits(tmp_path):
    folder = planes(tmp_path / "planes", NAMES["micro-manager"])
    (folder / "metadata.txt").write_text(
        '{"Summary": {"PixelSize_um": 0.108, "z-step_um": 0.25, "BitDepth": 12}, "Objective-Label": "63x/1.40 Oil"}'
    )
    gathered = gather([folder])
    stack, setup = gathered.stack, gathered.setup
    assert (stack.pixel_size, stack.focus_step, stack.bits) == ((0.108, 0.108), 0.25, 12)
    assert (setup.na, setup.immersion) == (1.4, 1.515)


def test_what_is_no_stack_of_files_is_refused_in_a_line(tmp_path):
    empty, bare, twice, odd = (tmp_path / name for name in ("empty", "bare", "twice", "odd"))
    empty.mkdir()
    (empty / "notes.txt").write_text("no image")
    bare.mkdir()
    planes(twice, lambda s, p: f"a{s}b{p}.tif")
    planes(odd, lambda _, p: f"plane{p}.tif", STACK[:1])
    tifffile.imwrite(odd / "plane3.tif", STACK[0, 0, :4])
    (odd / "plane4.tif").unlink()
    for paths, words in (
        ([empty], r"empty: holds notes\.txt, but no images; a folder of planes has files that end in \.tif, "),
        ([bare], "bare: is empty; a folder of planes has files that end in"),
        ([], "no stack is named"),
        ([odd, twice], "is a folder; give one folder, or files"),
        ([odd], r"plane3\.tif: settings .* 1 × 1 × 4 × 6, but .*plane0\.tif has 1 × 1 × 5 × 6: the files of one stack"),
        ([twice], r"2 parts of the names change \(a0b0\.tif, a1b11\.tif\): name prism settings channel1"),
        ([tmp_path / "none.tif"], "no such file"),
    ):
        with pytest.raises(StackError, match=words) as caught:
            gather(paths)
        assert "\n" not in str(caught.value)


def test_the_file_that_a_stack_of_settings_and_planes_lacks_is_named(tmp_path):
    folder = planes(tmp_path / "gap", NAMES["micro-manager"])
    (folder / "img_channel001_position000_time000000000_z003.tif").unlink()
    said = r"23 files are not 2 settings × 12 planes: img_channel001_position000_time000000000_z003\.tif is missing"
    with pytest.raises(StackError, match=said):
        gather([folder])
    twice = planes(tmp_path / "twice", NAMES["c and z"])
    (twice / "img_c1_z03.tif").write_bytes((twice / "img_c1_z3.tif").read_bytes())
    with pytest.raises(StackError, match=r"img_c1_z0?3\.tif and img_c1_z0?3\.tif are of one setting and plane"):
        gather([twice])


# names of the planes, and the focus step in µm that they say
DEPTHS = {
    "signs": (lambda s, p: f"z{p - 6}.tif", None),
    "signs and decimals": (lambda s, p: f"z{p / 2 - 3:+.1f}um.tif", 0.5),
    "a dash for minus": (lambda s, p: f"z {p - 6} µm.tif".replace("-", "−"), 1.0),
    "commas": (lambda s, p: f"cell_focus={p * 0.25:.2f} micron.tif".replace("0.", "0,").replace("1.", "1,"), 0.25),
    "decimals of unlike length": (lambda s, p: f"depth{p / 4:g}um.ome.tif", 0.25),
    "nanometres": (lambda s, p: f"z{300 * p}nm.tif", 0.3),
    "rounded": (lambda s, p: f"z{p / 3:.1f}um.tif", 3.7 / 11),
    "hyphens": (lambda s, p: f"z-{p + 1}.tif", None),
    "sections": (lambda s, p: f"z1.{p + 1}.tif", None),
    "a time without a unit of length": (lambda s, p: f"t{p}s.tif", None),
    "a time of more digits than a float has": (lambda s, p: f"t{20261129123456789000 + p}.tif", None),
}


@pytest.mark.parametrize("case", DEPTHS)
def test_depths_in_names_may_have_signs_decimals_and_a_unit(tmp_path, case):
    name, step = DEPTHS[case]
    stack = gather([planes(tmp_path / "planes", name, STACK[:1])]).stack
    assert np.array_equal(stack.data, STACK[:1])
    assert stack.focus_step == pytest.approx(step)


@pytest.mark.parametrize(
    "name",
    [
        lambda s, p: f"{('minus', 'plus')[s]}_z{p - 6:+}.tif",
        lambda s, p: f"bias-{s}_z{p / 2 - 3:.1f}um.tif",
        lambda s, p: f"bias{('-', '+')[s]}90_z{p / 2 - 3:+.1f}um.tif",
        lambda s, p: f"z{p} bias={(22.5, 67.5)[s]} deg.tif",
        lambda s, p: f"{p}_shear{s - 1}.tif",
    ],
)
def test_settings_are_told_beside_planes_also_by_signs(tmp_path, name):
    assert np.array_equal(gather([planes(tmp_path / "planes", name)]).stack.data, STACK)


def test_depths_that_say_too_little_are_told(tmp_path):
    below = planes(tmp_path / "below", lambda _, p: f"z-{p / 2 + 0.5:.1f}um.tif", STACK[:1])
    with pytest.raises(
        StackError, match=r"a minus or a hyphen stands before the depths of all names \(z-0\.5um\.tif, "
    ):
        gather([below])
    elsewhere = planes(tmp_path / "elsewhere", lambda _, p: f"at{p - 6}.tif", STACK[:1])
    with pytest.raises(StackError, match=r"of one setting and plane: signs and decimals are read only after z, plane"):
        gather([elsewhere])
    gap = planes(tmp_path / "gap", lambda _, p: f"z{p / 2 - 3:+.1f}um.tif", STACK[:1])
    (gap / "z-1.5um.tif").unlink()
    with pytest.warns(StackWarning, match=r"z-2\.0um\.tif and z-1\.0um\.tif are further apart than other planes"):
        gather([gap])
    lacking = planes(tmp_path / "lacking", lambda s, p: f"c{s}_z{p - 6}.tif")
    (lacking / "c1_z-2.tif").unlink()
    with pytest.raises(StackError, match=r"23 files are not 2 settings × 12 planes: c1_z-2\.tif is missing"):
        gather([lacking])


def test_a_plane_that_the_names_leave_out_is_warned_of(tmp_path):
    """Every second plane is no gap."""
    folder = planes(tmp_path / "planes", lambda _, p: f"cell z{p:02}.tif", STACK[:1])
    (folder / "cell z03.tif").unlink()
    with pytest.warns(
        StackWarning, match=r"cell z03\.tif is missing between cell z02\.tif and cell z04\.tif; the planes"
    ):
        assert gather([folder]).stack.data.shape == (1, 11, 5, 6)
    for plane in range(1, 12, 2):
        (folder / f"cell z{plane:02}.tif").unlink(missing_ok=True)
    assert gather([folder]).stack.data.shape == (1, 6, 5, 6)


def test_a_jpeg_is_refused_with_how_to_export_it(tmp_path):
    folder = tmp_path / "jpegs"
    folder.mkdir()
    imagecodecs = pytest.importorskip("imagecodecs")
    (folder / "cell.jpg").write_bytes(imagecodecs.jpeg_encode(STACK[0, 0].astype(np.uint8)))
    (folder / "cell.tif").write_bytes((folder / "cell.jpg").read_bytes())  # a JPEG by another name
    for path in (folder / "cell.jpg", folder / "cell.tif"):
        with pytest.raises(StackError, match=r"is a JPEG, whose compression has changed its greys; .* Save As > Tiff…"):
            gather([path])
    (folder / "cell.tif").unlink()
    with pytest.raises(StackError, match=r"cell\.jpg: is a JPEG"):
        gather([folder])


# --- what files say ---------------------------------------------------------------------------------------------------

WORDS = {
    "Information|Instrument|Objective|LensNA #1 = 0.75\nImmersion #1 = Air": (0.75, 1.0),
    "ObjectiveLabel: Plan-Apochromat 63x/1.40 Oil DIC": (1.4, 1.515),
    "Nikon Plan Apo 60x NA 1.2 Water": (1.2, 1.333),
    '"NumericalAperture": 0.95, "Immersion": "Dry"': (0.95, 1.0),
    "63x/1,4 Oil": (1.4, 1.515),
    "Exposure=20, Gain=1.4": (None, None),
}


@pytest.mark.parametrize("words", WORDS)
def test_aperture_and_immersion_are_found_in_a_programs_words(words):
    setup = setup_in_words(words)
    assert (setup.na, setup.immersion) == WORDS[words]


def test_ome_says_the_objective_that_was_used(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, STACK, (0.1, 0.1), 0.5)
    with tifffile.TiffFile(path) as tif:
        xml = str(tif.ome_metadata)
    lenses = '<Objective ID="O:0" LensNA="0.3"/><Objective ID="O:1" LensNA="1.3" Immersion="Glycerol" Model="HC"/>'
    xml = xml.replace("<Image ", f'<Instrument ID="I:0">{lenses}</Instrument><Image ', 1)
    xml = xml.replace("<Pixels ", '<ObjectiveSettings ID="O:1" RefractiveIndex="1.46"/><Pixels ', 1)
    tifffile.tiffcomment(path, xml.replace("<Channel ", '<Channel EmissionWavelength="546" ').encode())
    setup = gather([path]).setup
    assert (setup.na, setup.immersion, setup.objective, setup.wavelength) == (1.3, 1.46, "HC", pytest.approx(0.546))
