"""Hard cases × (forward, gradient) × (float32, float64) × (projection, rays, wave), every cell held to a law.

`make stability` runs all cells and prints what was measured; make test runs a sample of them.
"""

import warnings
from dataclasses import replace
from functools import cache

import pytest
import torch
from hard_cases import CASES, GRID, N0, Case, Scene, smooth

# Gradients smaller than this, per unit of a weighted sum of some hundred pixels, count as 0.
FLOOR = 0.01
CELLS = [
    pytest.param(
        case,
        propagation,
        id=f"{case.name}-{propagation}",
        marks=[pytest.mark.slow] if case.slow or (propagation == "rays" and not case.sample) else [],
    )
    for case in CASES
    for propagation in ("projection", "rays", "wave")
]


def eps(dtype):
    return torch.finfo(dtype).eps


def values_in(case, dtype):
    return {name: value.to(dtype) for name, value in case.scene().start().items()}


def weighted(case, propagation, values):
    """The images, with a weight for each pixel, so that in their sum every pixel matters and none cancels another."""
    images = case.scene().images(propagation, values)
    generator = torch.Generator().manual_seed(1)
    return images * torch.rand(images.shape, generator=generator, dtype=torch.float64).to(images)


def loss(case, propagation, values):
    return weighted(case, propagation, values).sum()


@cache
def images_of(case: Case, propagation: str, dtype: torch.dtype) -> torch.Tensor:
    return case.scene().images(propagation, values_in(case, dtype))


@cache
def gradient_of(case: Case, propagation: str, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    values = {name: value.requires_grad_() for name, value in values_in(case, dtype).items()}
    return dict(zip(values, torch.autograd.grad(loss(case, propagation, values), list(values.values())), strict=True))


@cache
def beside(case: Case, propagation: str) -> Case:
    """The case, moved off a kink."""
    size = case.beside.get(propagation)
    if size is None:
        return case
    scene = case.scene()
    return replace(case, scene=lambda: replace(scene, delta=scene.delta + smooth(size, scene.grid)))


def central_difference(case, propagation, directions, step):
    start = values_in(case, torch.float64)

    def at(t):
        return float(loss(case, propagation, {**start, **{n: start[n] + t * d for n, d in directions.items()}}))

    with torch.no_grad():
        return (at(step) - at(-step)) / (2 * step)


def terms(case, propagation, name, step=1e-4):
    """The sum of the sizes of what each pixel adds to a scalar's gradient: their roundings do not cancel as they do."""
    start = values_in(case, torch.float64)
    with torch.no_grad():
        more, less = (weighted(case, propagation, {**start, name: start[name] + t}) for t in (step, -step))
    return (more - less).abs().sum() / (2 * step)


def check(record_property, case, propagation, kind, dtype, law, measured, limit):
    cell = (case.name, propagation, kind, str(dtype).removeprefix("torch."), law, measured, limit)
    record_property("stability", cell)
    assert measured <= limit, cell


def refused_as(case, propagation, attempt):
    error, line = case.refused[propagation]
    with pytest.raises(error, match=line) as raised:
        attempt()
    assert "\n" not in str(raised.value)
    return error.__name__


@pytest.fixture(autouse=True)
def _warnings(request):
    """Each case's own warnings are looked for; any other is an error."""
    case = request.node.callspec.params.get("case") if hasattr(request.node, "callspec") else None
    with warnings.catch_warnings():
        for category, _ in case.warned.values() if case else ():
            warnings.simplefilter("ignore", category)
        yield


@pytest.mark.parametrize(("case", "propagation"), CELLS)
def test_image_obeys_its_law(record_property, case, propagation, dtype):
    def cell(*law):
        check(record_property, case, propagation, "image", dtype, *law)

    if propagation in case.refused:
        name = refused_as(case, propagation, lambda: case.scene().images(propagation, values_in(case, dtype)))
        cell(f"refused: {name}", 0, 0)
        return
    images = images_of(case, propagation, dtype)
    assert images.dtype == dtype
    assert bool(images.isfinite().all())
    assert float(images.min()) >= 0
    if dtype == torch.float32:
        error = float((images - images_of(case, propagation, torch.float64)).abs().max()) / eps(dtype)
        cell("float64's, eps", error, case.law("rounding", propagation))
    elif case.exact is not None:
        cell("exact", float((images - case.exact(case.scene())).abs().max()), case.tolerance)
    else:
        # some roundings, where light is conserved exactly
        cell("light", float(images[1].mean()), case.law("bright", propagation) + 1e-14)


GRADIENTS = [
    pytest.param(
        dtype,
        *cell.values,
        id=f"{str(dtype).removeprefix('torch.')}-{cell.id}",
        marks=cell.marks if cell.values[0].sample else [pytest.mark.slow],
    )
    for dtype in (torch.float32, torch.float64)
    for cell in CELLS
]


@pytest.mark.parametrize(("dtype", "case", "propagation"), GRADIENTS)
def test_gradient_obeys_its_law(record_property, case, propagation, dtype):
    def cell(*law):
        check(record_property, case, propagation, "gradient", dtype, *law)

    if propagation in case.refused:
        name = refused_as(case, propagation, lambda: gradient_of(case, propagation, dtype))
        cell(f"refused: {name}", 0, 0)
        return
    gradient = gradient_of(case, propagation, dtype)
    assert all(bool(g.isfinite().all()) for g in gradient.values()), [n for n, g in gradient.items() if g.isnan().any()]
    case = beside(case, propagation)
    gradient = gradient_of(case, propagation, dtype)
    if dtype == torch.float32:
        exact = gradient_of(case, propagation, torch.float64)
        sizes = {n: terms(case, propagation, n) if n in case.cancels else g.norm() for n, g in exact.items()}
        error = max(float((gradient[n] - g).norm() / sizes[n].clamp_min(FLOOR)) for n, g in exact.items())
        cell("float64's, eps", error / eps(dtype), case.law("gradient_rounding", propagation))
    else:
        directions = {n: torch.rand_like(g) * torch.where(g < 0, -1.0, 1.0) for n, g in gradient.items()}
        fields = [name for name in gradient if name in ("delta", "absorption")]
        scalars = [name for name in gradient if name not in fields]
        error = 0.0
        for names in [scalars] if propagation in case.alone else [scalars, *([name] for name in fields)]:
            some = {name: directions[name] for name in names}
            step = case.law("step", propagation) if names != scalars else 1e-5
            expected = central_difference(case, propagation, some, step)
            found = sum(float((gradient[name] * d).sum()) for name, d in some.items())
            error = max(error, abs(found - expected) / max(abs(expected), FLOOR))
        cell("difference", error, case.law("difference", propagation))


WARNED = [cell for cell in CELLS if cell.values[1] in set(cell.values[0].warned) - set(cell.values[0].refused)]


# --- warnings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("case", "propagation"), WARNED)
def test_case_is_warned_about_in_a_line_that_says_what_to_do(case, propagation):
    category, line = case.warned[propagation]
    with pytest.warns(category, match=line):
        case.scene().images(propagation, values_in(case, torch.float64))


@pytest.mark.filterwarnings("ignore::torchdic.SamplingWarning")
def test_light_that_rounds_onto_the_mediums_index_is_refused(propagation):
    """1.36 − 1e-8 is below the index in float64 and equal to it in float32, where p_z would be 0."""
    scene = Scene(torch.full(GRID.shape, 1e-3, dtype=torch.float64), sources=((0.0, N0 - 1e-8),), na=1.0, na_c=1.0)
    double, single = ({n: v.to(d) for n, v in scene.start().items()} for d in (torch.float64, torch.float32))
    with pytest.raises(ValueError, match=r"direction n·sinθ 1\.36 must stay below the medium's index 1\.36"):
        scene.images(propagation, single)
    if propagation == "projection":
        assert bool(scene.images(propagation, double).isfinite().all())
