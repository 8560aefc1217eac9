import numpy as np
import pytest
import torch
from matplotlib import image as pictures
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from recon.fit.problem import Recipe
from recon.report import figures
from recon.report.comparison import Score, Truth, compare, table
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import read_volume

GRID = Grid((4, 9, 12), (0.5, 0.2, 0.25))
PRISMS = (Prism((0.0, 0.24), 1.5), None, Prism((0.24, 0.0), -1.2))


def panels(figure):
    """The axes that show an image, without colour bars."""
    return [ax for ax in figure.axes if ax.images and ax.get_label() != "<colorbar>"]


def shown(ax):
    return np.asarray(ax.images[0].get_array())


def bars(ax):
    return [p for p in ax.patches if isinstance(p, Rectangle)]


def drawn(figure, path):
    """The figure as it is saved; drawing raises whatever is wrong with it."""
    figures.save(figure, path)
    return pictures.imread(path)


# images


@pytest.mark.parametrize(
    ("focus", "planes", "prisms"),
    [
        pytest.param(focus, planes, prisms, id=f"{planes}-{name}", marks=() if name == fast else pytest.mark.slow)
        for focus, planes, fast in (
            ((0.5,), [0], "bright field"),
            ((0.0, 1.0), [0, 1], "one"),
            (range(9), [2, 4, 6], "three"),
        )
        for name, prisms in (("three", PRISMS), ("one", PRISMS[:1]), ("bright field", PRISMS[1:2]))
    ],
)
def test_each_prism_shows_measured_modelled_and_residual(tmp_path, prisms, focus, planes):
    measured, modelled = torch.rand(2, len(prisms), len(focus), 9, 12)
    figure = figures.draw_images(measured, modelled, prisms, focus, GRID)
    axes = panels(figure)
    assert len(axes) == 3 * len(planes) * len(prisms)
    for p in range(len(prisms)):
        for k, plane in enumerate(planes):
            trio = axes[3 * (p * len(planes) + k) :][:3]
            expected = measured[p, plane], modelled[p, plane], (measured - modelled)[p, plane]
            assert all(np.array_equal(shown(ax), e.numpy()) for ax, e in zip(trio, expected, strict=True))
            assert trio[0].images[0].get_clim() == trio[1].images[0].get_clim()  # one scale for both
            low, high = trio[2].images[0].get_clim()
            assert low == -high < 0
    assert {ax.get_title().split("\n")[0] for ax in axes[:3]} == {"measured", "modelled", "residual"}
    assert f"focus {focus[planes[0]]:g} µm" in axes[0].get_title()
    assert drawn(figure, tmp_path / "images.png").std() > 0.01


def test_each_row_of_images_has_scales_of_grey_and_of_the_residual():
    measured = torch.stack([torch.rand(3, 40, 50), 0.2 * torch.rand(3, 40, 50)])
    figure = figures.draw_images(measured, measured * 0.9, PRISMS[:2], range(3), GRID)
    greys = [ax for ax in figure.axes if ax.get_ylabel() == "intensity"]
    for bar, row in zip(greys, measured, strict=True):
        assert bar.get_ylim() == pytest.approx((float(row.min()), float(row.max())), abs=0.004)
    assert sum(ax.get_ylabel() == "residual" for ax in figure.axes) == 2


def test_a_perfect_model_has_a_residual_that_can_be_drawn(tmp_path):
    data = torch.rand(1, 1, 9, 12)
    drawn(figures.draw_images(data, data, PRISMS[:1], (0.0,), GRID), tmp_path / "images.png")


def test_bright_field_and_prisms_are_told_apart():
    data = torch.rand(3, 1, 9, 12)
    axes = panels(figures.draw_images(data, data + 1, PRISMS, (0.0,), GRID))
    labels = [axes[3 * p].get_ylabel() for p in range(3)]
    assert labels[1] == "bright field"
    assert labels[0] == "shear 0.24 µm\nat 0°\nbias 85.9°"
    assert labels[2] == "shear 0.24 µm\nat 90°\nbias −68.8°"


@pytest.mark.parametrize(("planes", "columns"), [(1, 1), pytest.param(7, 7, marks=pytest.mark.slow), (20, 7)])
def test_a_stacks_planes_are_evenly_chosen_from_first_to_last(tmp_path, planes, columns):
    stack = torch.rand(2, planes, 9, 12)
    figure = figures.draw_stack(stack, PRISMS[:2], range(planes), (0.2, 0.25))
    axes = panels(figure)
    assert len(axes) == 2 * columns
    assert np.array_equal(shown(axes[0]), stack[0, 0].numpy())
    assert np.array_equal(shown(axes[-1]), stack[1, -1].numpy())
    drawn(figure, tmp_path / "stack.png")


def test_each_row_of_a_stack_has_its_scale_of_grey():
    stack = torch.stack([torch.rand(3, 40, 50), 0.2 * torch.rand(3, 40, 50)])
    figure = figures.draw_stack(stack, PRISMS[:2], range(3), (0.2, 0.25))
    bars = [ax for ax in figure.axes if ax.get_ylabel() == "intensity"]
    for bar, row in zip(bars, stack, strict=True):
        assert bar.get_ylim() == pytest.approx((float(row.min()), float(row.max())), abs=0.004)


def test_a_few_hot_pixels_do_not_decide_the_scale_of_grey():
    stack = torch.rand(1, 3, 40, 50)
    plain = figures.draw_stack(stack, PRISMS[:1], range(3), (0.2, 0.25)).axes[0].images[0]
    stack[0, 1, 3:5, 7] = 60.0
    hot = figures.draw_stack(stack, PRISMS[:1], range(3), (0.2, 0.25)).axes[0].images[0]
    assert hot.get_clim() == pytest.approx(plain.get_clim(), abs=0.01)


def test_rows_run_down_the_picture():
    ax = panels(figures.draw_stack(torch.rand(1, 1, 9, 12), PRISMS[:1], (0.0,), (0.2, 0.25)))[0]
    bottom, top = ax.get_ylim()
    assert bottom > top
    assert ax.images[0].get_extent() == pytest.approx([0, 12 * 0.25, 9 * 0.2, 0])


# sections


@pytest.fixture
def spot():
    """One bright voxel off the centre, so that its sections are known."""
    volume = torch.zeros(GRID.shape)
    volume[1, 6, 3] = 0.03
    return volume


def test_sections_go_through_the_centre_of_the_specimen(tmp_path, spot):
    figure = figures.draw_sections({"": spot}, GRID)
    xy, xz, yz = panels(figure)
    assert np.array_equal(shown(xy), spot[1].numpy())
    assert np.array_equal(shown(xz), spot[:, 6].numpy())
    assert np.array_equal(shown(yz), spot[:, :, 3].numpy())
    assert [(ax.get_xlabel(), ax.get_ylabel()) for ax in (xy, xz, yz)] == [("x", "y"), ("x", "z"), ("y", "z")]
    assert xy.images[0].get_extent() == pytest.approx([0, 3.0, 1.8, 0])
    assert xz.images[0].get_extent() == pytest.approx([0, 3.0, 2.0, 0])
    assert yz.images[0].get_extent() == pytest.approx([0, 1.8, 2.0, 0])
    assert [ax.get_title(loc="right") for ax in (xy, xz, yz)] == ["z = −0.25 µm", "y = 0.4 µm", "x = −0.625 µm"]
    assert any(ax.get_ylabel() == "Δn" for ax in figure.axes)
    drawn(figure, tmp_path / "sections.png")


def test_sections_go_through_one_of_two_beads_and_not_between_them():
    volume = torch.zeros(5, 20, 22)
    volume[1:4, 3:7, 3:7] = 0.02
    volume[1:4, 13:17, 14:18] = 0.03
    xy, xz, yz = panels(figures.draw_sections({"": volume}, Grid((5, 20, 22), GRID.spacing)))
    assert all(float(shown(ax).max()) == pytest.approx(0.03) for ax in (xy, xz, yz))


def test_volumes_side_by_side_share_their_place_and_scale(spot):
    other = torch.rand(GRID.shape) * 0.05
    axes = panels(figures.draw_sections({"truth": spot, "wave": other}, GRID, ("xy", "xz")))
    assert len(axes) == 4
    assert len({ax.images[0].get_clim() for ax in axes}) == 1
    assert axes[0].images[0].get_clim() == pytest.approx((0, float(other.max())))
    assert any(np.array_equal(shown(ax), other[1].numpy()) for ax in axes)
    assert [ax.get_title() for ax in axes if ax.get_title()] == ["truth", "wave"]


@pytest.mark.parametrize("shape", [(1, 9, 12), (1, 1, 12), (4, 1, 12), (4, 9, 1)])
def test_a_volume_of_one_slice_has_sections(tmp_path, shape):
    figure = figures.draw_sections({"": torch.rand(shape)}, Grid(shape, GRID.spacing))
    assert [shown(ax).shape for ax in panels(figure)] == [shape[1:], (shape[0], shape[2]), shape[:2]]
    drawn(figure, tmp_path / "sections.png")


def test_an_empty_and_a_negative_volume_have_sections(tmp_path):
    for volume in (torch.zeros(GRID.shape), -0.01 * torch.rand(GRID.shape)):
        drawn(figures.draw_sections({"": volume}, GRID), tmp_path / "sections.png")


# scale bars and curves


@pytest.mark.parametrize(
    ("width", "length"),
    [(4.0, 1.0), (3.99, 0.5), (10.88, 2.0), (12.8, 2.0), (20.0, 5.0), (40.0, 10.0), (0.1, 0.02), (200.0, 50.0)],
)
def test_a_scale_bar_is_as_long_as_it_says(width, length):
    stack = torch.rand(1, 1, 8, 16)
    ax = panels(figures.draw_stack(stack, PRISMS[:1], (0.0,), (width / 16, width / 16)))[0]
    (bar,) = bars(ax)
    assert bar.get_width() == pytest.approx(length)
    assert [text.get_text() for text in ax.texts] == [f"{length:g} µm"]
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    assert right - left == pytest.approx(width)  # the axis is in µm
    assert left < bar.get_x() < bar.get_x() + bar.get_width() < right
    assert top < bar.get_y() < bar.get_y() + bar.get_height() < bottom


def test_every_section_has_its_scale_bar(spot):
    axes = panels(figures.draw_sections({"": spot}, GRID))
    assert [bars(ax)[0].get_width() for ax in axes] == pytest.approx([0.5, 0.5, 0.2])


def test_the_misfit_is_drawn_over_the_steps_on_a_logarithmic_scale(tmp_path):
    figure = figures.draw_misfit([(1, 0.9, 1.0, 0.1), (2, 0.1, 0.2, 0.2), (3, 0.01, 0.1, 0.3)])
    (ax,) = figure.axes
    assert ax.get_yscale() == "log"
    assert ax.lines[0].get_xydata().tolist() == [[1, 0.9], [2, 0.1], [3, 0.01]]
    drawn(figure, tmp_path / "misfit.png")


def test_a_figure_that_cannot_be_saved_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "misfit.png"
    path.write_bytes(b"earlier")
    figure = figures.draw_misfit([(1, 0.9, 1.0, 0.1)])

    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(MemoryError):
        figures.save(figure, path)
    assert path.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [path]


# propagations compared


def test_compare_leaves_every_volume_a_picture_and_the_numbers(tmp_path, capsys):
    microscope = Microscope(0.546, Objective(0.6), Condenser(0.3))
    acquisition = Acquisition(PRISMS[:1], [-0.5, 0.5])
    truth = torch.zeros(GRID.shape)
    truth[1:3, 3:7, 4:8] = 0.01
    with torch.no_grad():
        data = image(Volume(GRID, truth, 1.5), microscope, acquisition, Fidelity(sources=4))
    contenders = [(Fidelity(name, sources=3), Recipe(steps=3)) for name in ("projection", "wave")]
    known = Truth(GRID, truth, 1.5, inside=truth > 0)
    scores = compare(data, known, microscope, acquisition, contenders, tmp_path)
    assert [score.propagation for score in scores] == ["projection", "wave"]
    names = {"truth.ome.tif", "projection.ome.tif", "wave.ome.tif", "comparison.png", "comparison.json"}
    assert {p.name for p in tmp_path.iterdir()} == names
    for score in scores:
        delta, grid = read_volume(tmp_path / f"{score.propagation}.ome.tif")
        assert grid == GRID
        assert score.mean_delta == pytest.approx(float(delta[truth > 0].mean()))
        assert score.volume_error == pytest.approx(float((delta - truth).norm() / truth.norm()))
    assert capsys.readouterr().err.count("projection") >= 1  # its progress bar


def test_the_table_has_a_row_for_each_score_and_the_truth():
    scores = [Score("wave", 0.1314, 0.02951, 0.0123, 12.34), Score("rays", 0.5, 0.02, 0.2, 100.0)]
    lines = table(scores, 0.03).splitlines()
    assert lines[1].split() == ["wave", "0.131", "0.0295", "0.0123", "12.3"]
    assert lines[-1].split() == ["truth", "0.000", "0.0300"]
    assert len(lines) == 4
    assert len({len(line) for line in lines[:3]}) == 1


def test_a_scripts_figure_makes_its_folder_and_says_where_it_is(tmp_path, capsys):
    path = tmp_path / "new" / "picture.png"
    assert figures.leave(Figure(), path) == 0
    assert capsys.readouterr().out == f"{path}\n"
    assert pictures.imread(path).ndim == 3


def test_a_folder_that_cannot_be_is_one_line_and_exit_2(tmp_path, capsys):
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert figures.leave(Figure(), tmp_path / "file" / "picture.png") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "file") in line
