"""The page of an experiment in a headless Chromium: its keys, mouse and pixels against values worked out here.

Needs the package playwright (of the extra ``test``) and a Chromium: Debian's, Chrome, or what
``playwright install chromium`` leaves.
"""

from __future__ import annotations

import base64
import contextlib
import os
import shutil

import numpy as np
import pytest

from tests.results_folder import METHODS, SCENES, radiance, write_results
from tools import report
from tools.false_color import TABLE
from tools.metrics import error_map
from tools.report_pixels import decode, encode
from tools.results import load_results
from wavefront.output import tone_map

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
METRICS = ("relmse", "mse", "mae", "mape", "smape", "mrse")


@pytest.fixture(scope="module")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    with playwright.sync_playwright() as driver:
        try:
            made = driver.chromium.launch(executable_path=found, args=["--no-sandbox"] * (os.geteuid() == 0))
        except playwright.Error as error:
            pytest.skip(f"no Chromium can be started: {str(error).splitlines()[0]}")
        yield made
        made.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = write_results(tmp_path_factory.mktemp("browser") / "results", metrics=METRICS)
    assert report.main([str(made), "--crop", "room:lamp=5x3+2+4"]) == 0
    return made


class Viewer:
    """The viewer of a page: what a user does, and what is seen."""

    def __init__(self, page):
        self.page = page

    def press(self, *keys: str) -> Viewer:
        for key in keys:
            self.page.keyboard.press(key)
        return self.wait()

    def wait(self) -> Viewer:
        """Until all is drawn."""
        self.page.evaluate("() => new Promise(requestAnimationFrame)")
        self.page.wait_for_selector("#viewer[data-ready=true]", timeout=10_000)
        return self

    def view(self, pane: int = 0) -> np.ndarray:
        """Left and top of the image in a pane, and pixels of the pane per pixel of the image."""
        words = self.page.locator("#stage canvas").nth(pane).get_attribute("data-view")
        return np.array([float(word) for word in words.split()])

    def pixels(self, selector: str = "#stage canvas", number: int = 0) -> np.ndarray:
        """RGBA of a canvas, [height, width, 4]."""
        script = """(canvas) => {  // of a copy: the page itself reads nothing back, and the browser would complain
          const copy = new OffscreenCanvas(canvas.width, canvas.height);
          const context = copy.getContext("2d", {willReadFrequently: true}), blocks = [];
          context.drawImage(canvas, 0, 0);
          const image = context.getImageData(0, 0, canvas.width, canvas.height);
          for (let i = 0; i < image.data.length; i += 4096) {
            blocks.push(String.fromCharCode(...image.data.subarray(i, i + 4096)));
          }
          return [image.width, image.height, btoa(blocks.join(""))];
        }"""
        width, height, data = self.page.locator(selector).nth(number).evaluate(script)
        return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)

    def image(self, width: int, height: int, pane: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Colours in the middle of every pixel of the image, [height, width, 3], and which of them are seen."""
        canvas, (left, top, scale) = self.pixels(number=pane), self.view(pane)
        x = np.floor(left + (np.arange(width) + 0.5) * scale).astype(int)
        y = np.floor(top + (np.arange(height) + 0.5) * scale).astype(int)
        seen = ((y >= 0) & (y < canvas.shape[0]))[:, None] & ((x >= 0) & (x < canvas.shape[1]))[None]
        x, y = np.clip(x, 0, canvas.shape[1] - 1), np.clip(y, 0, canvas.shape[0] - 1)
        return canvas[y[:, None], x[None], :3], seen

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()

    def box(self, pane: int = 0) -> dict:
        return self.page.locator("#stage canvas").nth(pane).bounding_box()


@contextlib.contextmanager
def opened(browser, path, **options):
    """A page that is opened from the disk, without a network; at the end, nothing was fetched or complained of."""
    context = browser.new_context(viewport={"width": 1100, "height": 800}, offline=True, **options)
    page = context.new_page()
    address, requests, complaints = path.as_uri(), [], []
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(address)
    yield page
    assert requests == [address]
    assert complaints == []
    context.close()


@pytest.fixture
def viewer(browser, folder):
    """The viewer of `folder`, with the focus."""
    with opened(browser, folder / "report.html") as page:
        page.locator("#stage").focus()
        yield Viewer(page).wait()


def stored(name: str, scene: str = "room") -> np.ndarray:
    """An image as the page has it: rounded."""
    width, height = SCENES[scene]
    pixels = radiance(f"{scene} {name}", width, height)
    return decode(*encode(np.abs(pixels) if name == "reference" else pixels), height, width)


def assert_shown(viewer: Viewer, expected: np.ndarray, pane: int = 0, tolerance: int = 1) -> None:
    """The canvas has these 8-bit colours [height, width, 3]; a tenth of the image must be seen."""
    colours, seen = viewer.image(expected.shape[1], expected.shape[0], pane)
    assert seen.mean() > 0.1
    np.testing.assert_allclose(colours[seen].astype(int), expected[seen].astype(int), atol=tolerance)


# --- which image is seen, and how bright -------------------------------------------------------------------------


def test_keys_flip_images(viewer):
    for key, name in (("0", "reference"), ("2", "fast 16"), ("1", "slow 16"), ("ArrowRight", "fast 16")):
        viewer.press(key)
        assert_shown(viewer, tone_map(stored(name)))
    viewer.press("ArrowRight", "9")  # there is none
    assert_shown(viewer, tone_map(stored("fast 16")))
    viewer.press("ArrowLeft", "ArrowLeft", "ArrowLeft")
    assert_shown(viewer, tone_map(stored("reference")))
    viewer.press("1", "ArrowDown")  # a smaller budget
    assert_shown(viewer, tone_map(stored("slow 4")))
    viewer.press("ArrowUp", "ArrowUp")
    assert_shown(viewer, tone_map(stored("slow 16")))
    assert not np.array_equal(tone_map(stored("slow 4")), tone_map(stored("slow 16")))


def test_exposure(viewer):
    viewer.press("0")
    for keys, stops in ((["e", "e"], 1.0), (["Shift+E"] * 7, -2.5), (["e"], -2.0)):
        viewer.press(*keys)
        assert_shown(viewer, tone_map(stored("reference"), stops))
        assert viewer.text("#exposure-value") == f"{stops:+g} EV"
    viewer.page.locator("#exposure").fill("-12")
    viewer.wait()
    assert_shown(viewer, tone_map(stored("reference"), -12.0))  # what is brightest has detail still
    assert tone_map(stored("reference"), -12.0).max() > 0
    viewer.page.locator("#stage").focus()
    viewer.press("a")
    luminance = stored("reference") @ [0.2126, 0.7152, 0.0722]
    stops = np.log2(0.18) - np.log2(luminance).mean()
    assert float(viewer.text("#exposure-value").removesuffix(" EV")) == pytest.approx(stops, abs=0.1251)
    viewer.press("Home")
    assert_shown(viewer, tone_map(stored("reference")))


def test_scenes(viewer):
    viewer.page.get_by_role("button", name="box").click()
    viewer.wait()
    assert_shown(viewer, tone_map(stored("slow 16", "box")))
    assert viewer.page.get_by_role("button", name="box").get_attribute("aria-pressed") == "true"
    viewer.press("w", "s", "s")
    viewer.page.get_by_role("button", name="room").click()
    viewer.wait()
    assert_shown(viewer, tone_map(stored("slow 16")))


# --- where it is seen --------------------------------------------------------------------------------------------


def test_the_whole_image_fits(viewer):
    canvas, (left, top, scale) = viewer.pixels(), viewer.view()
    height, width = canvas.shape[:2]
    assert scale == pytest.approx(min(width / 24.0, height / 16.0))
    assert left == pytest.approx((width - 24.0 * scale) / 2.0)
    assert top == pytest.approx((height - 16.0 * scale) / 2.0)


def test_wheel_zooms_about_the_mouse(viewer):
    box = viewer.box()
    x, y = 0.3 * box["width"], 0.6 * box["height"]
    viewer.page.mouse.move(box["x"] + x, box["y"] + y)
    before = viewer.view()
    viewer.page.mouse.wheel(0, -500)
    viewer.wait()
    after = viewer.view()
    assert after[2] == pytest.approx(4.0 * before[2])  # 250 pixels of the wheel are a factor of two
    np.testing.assert_allclose(([x, y] - after[:2]) / after[2], ([x, y] - before[:2]) / before[2], atol=0.05)
    viewer.press("e", "2")
    colours, seen = viewer.image(24, 16)
    assert 0.02 < seen.mean() < 0.2
    np.testing.assert_allclose(colours[seen].astype(int), tone_map(stored("fast 16"), 0.5)[seen].astype(int), atol=1)
    viewer.press("-", "+", "+", "-")
    assert viewer.view()[2] == pytest.approx(after[2])
    viewer.press("Home")
    np.testing.assert_allclose(viewer.view(), before)


def test_wheel_scrolls_the_page_until_the_viewer_has_the_focus(viewer):
    viewer.page.evaluate(
        "() => { document.activeElement.blur(); scrollTo(0, document.getElementById('viewer').offsetTop) }"
    )
    before, box = viewer.view(), viewer.box()
    viewer.page.mouse.move(box["x"] + 50, box["y"] + 50)
    begin = viewer.page.evaluate("() => scrollY")
    viewer.page.mouse.wheel(0, -120)
    viewer.page.wait_for_timeout(300)
    assert viewer.page.evaluate("() => scrollY") == begin - 120
    np.testing.assert_array_equal(viewer.view(), before)


def test_pan_is_linked(viewer):
    """Side by side, all images show the same place, whichever is dragged."""
    viewer.press("s", "+", "+", "+", "+")
    assert viewer.page.locator("#stage canvas").count() == 3
    before, box = viewer.view(), viewer.box(1)
    viewer.page.mouse.move(box["x"] + 60, box["y"] + 70)
    viewer.page.mouse.down()
    viewer.page.mouse.move(box["x"] + 43, box["y"] + 81, steps=4)
    viewer.page.mouse.up()
    viewer.wait()
    for pane, name in enumerate(("reference", "slow 16", "fast 16")):
        np.testing.assert_allclose(viewer.view(pane), np.add(before, [-17.0, 11.0, 0.0]), atol=0.1)
        assert_shown(viewer, tone_map(stored(name)), pane)
    middle = (np.array([box["width"], box["height"]]) / 2.0 - viewer.view()[:2]) / viewer.view()[2]
    viewer.press("s")  # one image again: the same place in its middle
    canvas = viewer.box()
    alone = (np.array([canvas["width"], canvas["height"]]) / 2.0 - viewer.view()[:2]) / viewer.view()[2]
    np.testing.assert_allclose(alone, middle, atol=0.1)


def test_wipe(viewer):
    viewer.press("2", "w")
    left, right = tone_map(stored("fast 16")).astype(int), tone_map(stored("reference")).astype(int)

    def assert_line_at(share):
        colours, _ = viewer.image(24, 16)
        canvas, (offset, _, scale) = viewer.pixels(), viewer.view()
        middle = (np.round(share * canvas.shape[1]) - offset) / scale - 0.5  # of the line, in pixels of the image
        for columns, expected in ((np.arange(24) < middle - 0.4, left), (np.arange(24) > middle + 0.4, right)):
            assert columns.sum() >= 3
            np.testing.assert_allclose(colours[:, columns], expected[:, columns], atol=1)

    assert_line_at(0.5)
    box = viewer.box()
    viewer.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)
    viewer.page.mouse.down()
    viewer.page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 60, steps=3)
    viewer.page.mouse.up()
    viewer.wait()
    assert_line_at(0.25)
    viewer.press(".", ".", ",")
    assert_line_at(0.27)
    viewer.page.locator("#split").fill("0.7")
    viewer.wait()
    assert_line_at(0.7)
    viewer.page.locator("#against").select_option("1")
    viewer.wait()
    right = tone_map(stored("slow 16")).astype(int)
    assert_line_at(0.7)


# --- errors and crops --------------------------------------------------------------------------------------------


def colours_of(values: np.ndarray, white: float) -> np.ndarray:
    return TABLE[(np.clip(values / white, 0.0, 1.0) * 255.0 + 0.5).astype(int)]


STEP = int(np.abs(np.diff(TABLE.astype(int), axis=0)).max())  # rounding may give the next colour


def test_false_colours(viewer):
    viewer.press("f")
    for metric in METRICS:
        viewer.page.locator("#error-metric").select_option(metric)
        viewer.page.locator("#stage").focus()
        viewer.press("2")
        maps = {name: error_map(metric, stored(f"{name} 16"), stored("reference")) for name in METHODS}
        white = float(viewer.text("#white-value"))
        assert 0.7 <= np.quantile(maps["slow"], 0.98, method="higher") / white <= 1.75  # rounded to 1, 2 or 5
        assert_shown(viewer, colours_of(maps["fast"], white), tolerance=STEP)
        viewer.press("]", "]", "[", "]", "1")
        assert float(viewer.text("#white-value")) == pytest.approx(4.0 * white, rel=0.006)
        assert_shown(viewer, colours_of(maps["slow"], 4.0 * white), tolerance=STEP)
    viewer.press("0")
    assert_shown(viewer, tone_map(stored("reference")))  # which has no error
    viewer.press("1", "f")
    assert_shown(viewer, tone_map(stored("slow 16")))


def test_false_colours_of_flip(browser, tmp_path):
    pytest.importorskip("flip_evaluator", reason="the FLIP metric needs the package flip-evaluator")
    made = write_results(tmp_path / "flip", {"room": SCENES["room"]}, metrics=("flip", "mse"))
    assert report.main([str(made)]) == 0
    with opened(browser, made / "report.html") as page:
        page.locator("#stage").focus()
        viewer = Viewer(page).press("2", "f")
        assert page.locator("#error-metric").input_value() == "flip"
        errors = error_map("flip", radiance("room fast 16", *SCENES["room"]), stored("reference"))
        assert_shown(viewer, colours_of(errors, float(viewer.text("#white-value"))), tolerance=STEP)


def test_crops(viewer):
    """That of the command line, one chosen by the mouse, and their errors; all follow exposure and budget."""
    assert viewer.page.locator(".crop canvas").count() == 3
    viewer.press("e", "ArrowDown")
    names = ("reference", "slow 4", "fast 4")
    for number, name in enumerate(names):
        shown = viewer.pixels(".crop canvas", number)
        np.testing.assert_allclose(shown[..., :3], tone_map(stored(name), 0.5)[4:7, 2:7], atol=1)
    errors = error_map("relmse", stored("fast 4"), stored("reference"))
    words = viewer.page.locator(".crop figcaption").nth(2).inner_text().split()
    assert words[:2] == ["fast", "relMSE"]
    assert float(words[2]) == pytest.approx(errors[4:7, 2:7].mean(), rel=0.006)

    box, (left, top, scale) = viewer.box(), viewer.view()
    viewer.page.keyboard.down("Shift")
    viewer.page.mouse.move(box["x"] + left + 13.5 * scale, box["y"] + top + 9.5 * scale)
    viewer.page.mouse.down()
    viewer.page.mouse.move(box["x"] + left + 10.5 * scale, box["y"] + top + 4.5 * scale, steps=3)
    viewer.page.mouse.up()
    viewer.page.keyboard.up("Shift")
    viewer.wait()
    assert viewer.text(".crop:nth-child(2) .muted") == "4x6+10+4"
    shown = viewer.pixels(".crop canvas", 4)
    np.testing.assert_allclose(shown[..., :3], tone_map(stored("slow 4"), 0.5)[4:10, 10:14], atol=1)

    viewer.page.locator(".crop input").nth(1).fill("w2 edge")  # keys belong to the field
    assert viewer.page.locator("#stage canvas").count() == 1
    assert_shown(viewer, tone_map(stored("slow 4"), 0.5))
    viewer.page.get_by_role("button", name="Remove").first.click()
    viewer.wait()
    assert viewer.page.locator(".crop canvas").count() == 3
    assert viewer.page.locator(".crop input").input_value() == "w2 edge"


def test_pixel_under_the_mouse(viewer):
    box, (left, top, scale) = viewer.box(), viewer.view()
    viewer.press("2")
    viewer.page.mouse.move(box["x"] + left + 7.5 * scale, box["y"] + top + 3.5 * scale)
    words = viewer.text("#readout").split("·")
    assert words[0].strip() == "pixel 7, 3"
    for text, name in ((words[1], "fast 16"), (words[2], "reference")):
        np.testing.assert_allclose([float(x) for x in text.split()[1:]], stored(name)[3, 7], rtol=0.006)
    error = error_map("relmse", stored("fast 16"), stored("reference"))[3, 7]
    assert float(words[3].split()[1]) == pytest.approx(error, rel=0.006)


# --- the page ----------------------------------------------------------------------------------------------------


def test_table_is_sorted_by_its_headings(browser, tmp_path):
    """By mouse and keys, within every scene and budget; figures as numbers, and what has none last."""
    made = write_results(tmp_path / "results", {"room": SCENES["room"]}, ("slow", "fast", "another", "none"))
    assert report.main([str(made), "--images", "none"]) == 0
    with opened(browser, made / "report.html") as page:
        table = page.locator("table.results:visible")
        page.evaluate("""() => {  // figures that are sorted in another order as text, and one that is not known
          for (const body of document.querySelectorAll("table.results tbody")) {
            const cells = [...body.querySelectorAll("[data-name=time]")];
            ["9", "1e-05", "10.5"].forEach((value, i) => { cells[i].dataset.value = value; });
            cells[3].removeAttribute("data-value");
            cells[3].textContent = "";
          }
        }""")

        def assert_order(*methods):
            assert table.locator("tbody th").all_inner_texts() == ["room · 4 spp", *methods, "room · 16 spp", *methods]

        before = ("slow", "fast", "another", "none")
        assert_order(*before)
        time = table.get_by_role("button", name="time, s")
        for order, methods in (
            ("ascending", ("fast", "slow", "another", "none")),
            ("descending", ("another", "slow", "fast", "none")),
            (None, before),
        ):
            time.click()
            assert_order(*methods)
            assert table.locator("thead th").nth(4).get_attribute("aria-sort") == order
        time.press("Enter")
        time.press("Space")
        assert_order("another", "slow", "fast", "none")
        page.locator("#metric").select_option("mae")  # the order stays
        assert_order("another", "slow", "fast", "none")
        table.get_by_role("button", name="method").click()
        assert_order("another", "fast", "none", "slow")
        assert table.locator("[aria-sort]").all_inner_texts() == ["method"]
        table.get_by_role("button", name="MAE").click()  # those with the same error stay as they were
        assert_order("fast", "another", "none", "slow")
        table.get_by_role("button", name="speed-up over slow").click()  # that of the baseline is 1
        assert_order("slow", "fast", "another", "none")
        assert table.locator("thead button").count() == 7  # none on the intervals


def test_choice_of_the_metric(viewer):
    """The table and the plots change, and so do the captions."""
    assert viewer.page.locator("table.results:visible").count() == 1
    viewer.page.locator("#metric").select_option("mae")
    viewer.wait()
    assert "MAE" in viewer.text("table.results:visible thead")
    assert viewer.page.locator("svg.plot:visible").count() == 4
    assert viewer.text("#stage figcaption").startswith("slow, MAE ")


def test_every_control_has_a_name_and_can_be_reached(viewer):
    script = """() => [...document.querySelectorAll("button, input, select, canvas, svg[role=img], #stage")].map(e => [
      e.outerHTML.slice(0, 80),
      e.getAttribute("aria-label") || e.labels?.[0]?.innerText.trim() || (e.tagName === "BUTTON" && e.innerText.trim()),
      e.tabIndex >= 0 || e.tagName === "CANVAS" || e.tagName === "svg"])"""
    found = viewer.page.evaluate(script)
    assert len(found) > 25
    assert [words for words, name, reached in found if not (name and reached)] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_schemes_and_narrow_windows(viewer, scheme):
    viewer.page.emulate_media(color_scheme=scheme)
    script = "(key) => getComputedStyle(document.body)[key].match(/[0-9]+/g).map(Number)"
    back, text = (np.mean(viewer.page.evaluate(script, key)[:3]) for key in ("backgroundColor", "color"))
    assert (back > 200 and text < 60) if scheme == "light" else (back < 60 and text > 200)
    viewer.page.set_viewport_size({"width": 390, "height": 800})
    viewer.wait()
    assert viewer.page.evaluate("() => document.documentElement.scrollWidth") <= 390
    assert_shown(viewer, tone_map(stored("slow 16")))


def test_devices_with_more_pixels(browser, folder):
    with opened(browser, folder / "report.html", device_scale_factor=2) as page:
        viewer = Viewer(page).wait()
        assert viewer.pixels().shape[1] == round(2 * viewer.box()["width"])
        assert_shown(viewer, tone_map(stored("slow 16")))


def test_pages_of_other_results(browser, tmp_path):
    """Names that are HTML are text, and without images there is no viewer, and no error either."""
    evil = '</script><img src=x onerror="throw 1">&amp;'
    made = write_results(tmp_path / "evil", {evil: (6, 5)}, ("slow", evil), description=evil)
    assert report.main([str(made)]) == 0
    with opened(browser, made / "report.html") as page:
        viewer = Viewer(page).wait()
        assert page.locator("img").count() == 0
        assert viewer.text("#choices button >> nth=2") == f"2{evil}"
        assert (
            viewer.text("#scenes button")
            == viewer.text(".plots:visible h3")
            == viewer.text("header p >> nth=0")
            == evil
        )
    assert report.main([str(made), "--images", "none"]) == 0
    with opened(browser, made / "report.html") as page:
        page.locator("#metric").select_option("mae")
        page.keyboard.press("w")
        assert page.locator("table.results:visible").count() == 1
        assert not page.locator("#viewer").is_visible()


def test_results_are_those_that_were_written(folder):
    """What is expected above is what is in the files."""
    results = load_results(folder)
    np.testing.assert_array_equal(results.reference("room").image, np.abs(radiance("room reference", 24, 16)))
    record = next(r for r in results.records if (r.scene, r.method, r.samples, r.seed) == ("room", "fast", 16, 1))
    np.testing.assert_array_equal(results.image(record), radiance("room fast 16", 24, 16))
