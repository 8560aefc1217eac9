"""report.html in a real browser without a screen: what its sliders, keys and pointer change is what the files hold.

Playwright drives its own Chromium or the system's; without either of them these tests are skipped.
"""

import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from results_folder import GRID, images, leave_results, volume

from recon.report.figures import OUTSIDE
from recon.report.html.packed import LEVELS
from recon.report.html.page import leave_report

SYSTEMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# A canvas' height, width and bytes.
PIXELS = """canvas => {
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  return [canvas.height, canvas.width, ...data];
}"""

# As PIXELS, of a picture.
DRAWN = """picture => {
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [picture.naturalWidth, picture.naturalHeight];
  const context = canvas.getContext('2d');
  context.drawImage(picture, 0, 0);
  return [canvas.height, canvas.width, ...context.getImageData(0, 0, canvas.width, canvas.height).data];
}"""
FOCUSED = """() => {
  const found = document.activeElement;
  return [found.id || found.dataset.turn || found.tagName, getComputedStyle(found).outlineStyle];
}"""
# The colours of an element's letters, and of what lies behind them.
INK_AND_GROUND = """element => {
  let behind = element;
  while (getComputedStyle(behind).backgroundColor === 'rgba(0, 0, 0, 0)') behind = behind.parentElement;
  return [getComputedStyle(element).color, getComputedStyle(behind).backgroundColor];
}"""


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install 'torchdic[browser]'")
    with playwright.sync_playwright() as driver:
        own = driver.chromium.executable_path
        path = own if Path(own).exists() else next(filter(None, map(shutil.which, SYSTEMS)), None)
        if path is None:
            pytest.skip("no Chromium: playwright install chromium, or the system's package")
        # software draws WebGL; inside a container Chromium's own sandbox has no rights
        opened = driver.chromium.launch(executable_path=path, args=["--no-sandbox", "--enable-unsafe-swiftshader"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    leave_results(out)
    return leave_report(out).as_uri()


@pytest.fixture
def opened(browser, address):
    """A function that opens the page; at the end no error has come and nothing has been loaded."""
    told, loaded, pages = [], [], []

    def open_page(script="", **options):
        # so low that the view in three dimensions, which takes seconds without a GPU, isn't drawn unasked
        context = browser.new_context(**{"viewport": {"width": 1000, "height": 300}, **options})
        page = context.new_page()
        page.on("console", lambda message: told.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: told.append(str(error)))
        page.on("request", lambda request: loaded.append(request.url))
        page.add_init_script(script)
        page.goto(address)
        if options.get("java_script_enabled", True):
            page.wait_for_selector("html.ready")
            page.wait_for_function("document.getElementById('sections-said').textContent !== ''")
        pages.append(context)
        return page

    yield open_page
    for context in pages:
        context.close()
    assert told == []
    assert {url for url in loaded if not url.startswith(("data:", "blob:"))} == {address}


def pixels(page, selector):
    """A canvas' colours (row, column, 3)."""
    height, width, *values = page.locator(selector).evaluate(PIXELS)
    return np.array(values, np.uint8).reshape(height, width, 4)[..., :3]


def coloured(values, low, high, colours="viridis"):
    levels = np.clip(np.round((values - low) * (LEVELS / (high - low))), 0, LEVELS).astype(int)
    return (mpl.colormaps[colours](levels)[..., :3] * 255).round().astype(np.uint8)


def section(plane, z, y, x):
    delta = volume().numpy()
    return {"xy": delta[z], "zy": delta[:, :, x].T, "xz": delta[:, y]}[plane]


def sections_are(page, z, y, x, colours="viridis"):
    top = float(volume().max())
    for plane in ("xy", "zy", "xz"):
        shown = pixels(page, f"[data-plane={plane}] canvas")
        assert np.array_equal(shown, coloured(section(plane, z, y, x), 0, top, colours)), plane


def place(page):
    return tuple(int(page.locator(f"#place-{axis}").input_value()) for axis in "zyx")


def test_a_key_on_a_slider_moves_the_section_and_what_is_said(opened):
    page = opened()
    page.locator("#to").fill("255")  # all of the range
    z, y, x = place(page)
    sections_are(page, z, y, x)
    line = page.locator("[data-plane=xz] .across")
    before = line.evaluate("line => line.style.top")
    page.locator("#place-z").focus()
    page.keyboard.press("ArrowRight")
    assert place(page) == (z + 1, y, x)
    sections_are(page, z + 1, y, x)
    assert line.evaluate("line => line.style.top") != before
    micrometres = GRID.centre(0, z + 1)
    said = page.locator("#place-z").get_attribute("aria-valuetext")
    assert said == f"z {micrometres:g} µm, {z + 2} of {GRID.shape[0]}".replace("-", "−")
    value = float(volume()[z + 1, y, x])
    page.wait_for_timeout(400)
    told = page.locator("#sections-said").text_content()
    assert told.startswith("Δn at this point: ")
    assert float(told.split()[-1]) == pytest.approx(value, abs=float(volume().max()) / LEVELS)


def test_a_pointer_in_a_section_moves_the_two_others(opened):
    page = opened()
    page.locator("#to").fill("255")
    z = place(page)[0]
    frame = page.locator("[data-plane=xy] .frame")
    box = frame.bounding_box()
    nz, ny, nx = GRID.shape
    frame.click(position={"x": box["width"] * 2.5 / nx, "y": box["height"] * 8.5 / ny})
    assert place(page) == (z, 8, 2)
    sections_are(page, z, 8, 2)
    box = page.locator("[data-plane=zy] .frame").bounding_box()
    page.mouse.move(box["x"] + 1, box["y"] + 1)
    page.mouse.down()
    page.mouse.move(box["x"] + 2 * box["width"], box["y"] + box["height"] * 3.5 / ny)  # beyond the picture
    page.mouse.up()
    assert place(page) == (nz - 1, 3, 2)


def test_colours_and_scale_are_the_users(opened):
    page = opened()
    page.locator("#to").fill("255")
    page.locator("#colours").select_option("gray")
    z, y, x = place(page)
    sections_are(page, z, y, x, "gray")
    page.locator("#to").fill("128")
    top = float(volume().max()) * 128 / LEVELS
    assert page.locator("#to-value").text_content() == f"{top:.3g}"
    shown = pixels(page, "[data-plane=xy] canvas").astype(int)
    # a level of the volume and one of the scale, each to half of it
    assert np.abs(shown - coloured(section("xy", z, y, x), 0, top, "gray")).max() <= 2
    page.locator("#from").fill("200")  # beyond the other end, before which it stops
    assert int(page.locator("#from").input_value()) == 127


def test_plane_and_prism_choose_the_images(opened):
    page = opened()
    page.locator("#prism").focus()
    page.keyboard.press("ArrowRight")
    page.locator("#plane").focus()
    page.keyboard.press("Home")
    assert page.locator("#prism").get_attribute("aria-valuetext") == "2 of 2: bright field"
    assert page.locator("#plane").get_attribute("aria-valuetext") == "1 of 3: focus −1 µm"
    measured, modelled = images()
    low, high = np.quantile(measured[1], (OUTSIDE, 1 - OUTSIDE))
    for number, stack in enumerate((measured, modelled)):
        assert np.array_equal(
            pixels(page, f"[data-kind='{number}'] .frame canvas"), coloured(stack[1, 0], low, high, "gray")
        )
    page.wait_for_timeout(400)
    rms = float(np.sqrt(((measured - modelled)[1, 0] ** 2).mean()))
    assert f"The residual is {rms:.3g} rms" in page.locator("#images-said").text_content()


def test_every_control_is_reached_by_the_keyboard_and_shows_it(opened):
    page = opened()
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(page.evaluate(FOCUSED))
    assert {f"place-{axis}" for axis in "zyx"} | {"from", "to", "colours", "plane", "prism", "level", "left"} <= {
        name for name, _ in reached
    }
    assert {style for name, style in reached if name != "BODY"} == {"solid"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_letters_stand_out_from_their_ground(opened, scheme):
    """By the contrast that WCAG asks of text, 4.5."""
    page = opened(color_scheme=scheme)

    def luminance(colour):
        parts = np.array([int(part) for part in colour[colour.index("(") + 1 : -1].split(",")[:3]]) / 255
        return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722)

    for selector in ("main p", "h1", "h2", "#verdict", "dt", "small", "figcaption", ".value", "th", "footer p", "a"):
        ink, ground = page.locator(selector).last.evaluate(INK_AND_GROUND)
        light, dark = sorted((luminance(ink), luminance(ground)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 4.5, selector


@pytest.mark.parametrize("width", [360, 800])
def test_nothing_is_wider_than_a_small_screen(opened, width):
    page = opened(viewport={"width": width, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_without_scripts_the_verdict_and_the_curves_are_there(opened):
    page = opened(java_script_enabled=False)
    assert page.locator("#verdict").is_visible()
    assert page.locator(".plot svg").count() == 2
    assert not page.locator("#place-z").is_visible()


def test_without_webgl_the_page_says_so(opened):
    page = opened("""
      const found = HTMLCanvasElement.prototype.getContext;
      HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
        return kind.startsWith("webgl") ? null : found.call(this, kind, ...rest);
      };
    """)
    page.locator("#solid").scroll_into_view_if_needed()
    page.wait_for_selector("text=This browser shows no WebGL")


@pytest.mark.slow
def test_the_surface_is_drawn_and_turned_by_keys(opened):
    page = opened(viewport={"width": 700, "height": 900})
    page.locator("#solid").scroll_into_view_if_needed()
    page.wait_for_selector("#solid[data-drawn]")
    page.locator("#level").focus()
    page.keyboard.press("Home")
    page.wait_for_timeout(400)
    # at the lowest level: 15 % of the largest Δn that doesn't stand out
    inside = page.locator("#surface-said").text_content()
    level = float(page.locator("#level-value").text_content().split()[-1])
    enclosed = int((volume() > level).sum()) * float(np.prod(GRID.spacing))
    assert float(inside.split()[-2]) == pytest.approx(enclosed, rel=0.02)
    eye = page.evaluate("document.getElementById('solid').layout.scene.camera.eye")
    page.locator("[data-turn=left]").focus()
    page.keyboard.press("Enter")
    turned = page.evaluate("document.getElementById('solid').layout.scene.camera.eye")
    assert np.arctan2(turned["y"], turned["x"]) - np.arctan2(eye["y"], eye["x"]) == pytest.approx(np.pi / 12)
    picture = page.locator("#on-paper")
    page.wait_for_selector("#on-paper[src]", state="attached")
    assert not picture.is_visible()
    page.emulate_media(media="print")
    assert picture.is_visible()
    assert not page.locator("#solid").is_visible()
    height, width, *values = picture.evaluate(DRAWN)
    shades = np.array(values).reshape(height, width, 4)[..., :3].astype(int)
    green = (shades[..., 1] > shades[..., 0] + 30) & (shades[..., 1] > shades[..., 2] + 10)
    assert green.sum() > 1000  # the surface itself, not only its frame
