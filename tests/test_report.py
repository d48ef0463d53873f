"""The page of an experiment: its figures, its plots, how it holds images, and what it says of bad input."""

from __future__ import annotations

import html
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats

from tests.results_folder import METHODS, radiance, write_results
from tools import report
from tools.report_pixels import ABSOLUTE_ERROR, RELATIVE_ERROR, decode, encode
from tools.report_plots import COLOURS, LogAxis, curves, number, svg
from tools.results import EXPERIMENT, RECORDS, load_results
from tools.summary import summarise


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Path:
    """A folder of results with a page."""
    folder = write_results(tmp_path_factory.mktemp("report") / "known")
    assert report.main([str(folder)]) == 0
    return folder


class Page(HTMLParser):
    """Tags of a page, the texts of its scripts by id, and the rows of its tables."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.scripts, self.rows, self.words = [], {}, [], ""
        self.metric = self.script = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append(tag)
        self.script = attributes.get("id", "code") if tag == "script" else None
        if tag == "div" and "data-metric" in attributes:
            self.metric = attributes["data-metric"]
        elif tag == "tr":
            self.rows.append({"metric": self.metric})
        elif tag == "td" and "data-value" in attributes:
            keys = {"data-value": "", "data-low": " low", "data-high": " high"}
            for key in keys.keys() & attributes.keys():
                self.rows[-1][attributes["data-name"] + keys[key]] = float(attributes[key])

    def handle_endtag(self, tag):
        self.script = None if tag == "script" else self.script

    def handle_data(self, data):
        if self.script is not None:
            self.scripts[self.script] = self.scripts.get(self.script, "") + data
        else:
            self.words += data

    def figures(self, metric: str) -> list[dict]:
        """Rows of the table of a metric that are of a method."""
        return [row for row in self.rows if row["metric"] == metric and "error" in row]


def page_of(folder: Path) -> Page:
    return Page((folder / "report.html").read_text(encoding="utf-8"))


# --- the table ---------------------------------------------------------------------------------------------------


def test_figures_by_hand(known):
    """Of squared errors per sample 1.6 and 0.8 at 0.5 s, and 0.4 and 0.08 at 0.25 and 0.5 s."""
    slow4, fast4, slow16, fast16 = page_of(known).figures("mse")[:4]
    assert slow4["error"] == pytest.approx(1.2 / 4.0)
    assert fast16["error"] == pytest.approx(0.24 / 16.0)
    # s = (0.4 - 0.08) / 16 / sqrt(2) over sqrt(2) runs, and t(0.975; 1) = 12.7062
    assert fast16["error high"] - fast16["error"] == pytest.approx(12.7062047 * 0.32 / 16.0 / 2.0)
    assert (slow4["time"], fast4["time"], slow16["time"]) == pytest.approx((2.0, 1.5, 8.0))
    assert (slow4["spp"], fast16["spp"], slow4["runs"]) == (4.0, 16.0, 2.0)
    # Costs: 0.8 and 0.4; 0.1 and 0.04.
    for row, cost in ((slow4, 0.6), (slow16, 0.6), (fast4, 0.07), (fast16, 0.07)):
        assert row["efficiency"] == pytest.approx(1.0 / cost)
    assert fast16["speed-up"] == pytest.approx(0.6 / 0.07)
    parts = [(0.2 / 0.6) ** 2, (0.03 / 0.07) ** 2]
    degrees = sum(parts) ** 2 / sum(part**2 for part in parts)
    factor = math.exp(stats.t.ppf(0.975, degrees) * math.sqrt(sum(parts)))
    assert fast4["speed-up low"] == pytest.approx(0.6 / 0.07 / factor)
    assert fast4["speed-up high"] == pytest.approx(0.6 / 0.07 * factor)
    assert "speed-up" not in slow4
    # The absolute error counts squared, so that costs are the same.
    assert page_of(known).figures("mae")[1]["speed-up"] == pytest.approx(0.6 / 0.07)


@pytest.mark.parametrize("baseline", METHODS)
def test_figures_are_those_of_the_summary(known, tmp_path, baseline):
    assert report.main([str(known), "-o", str(tmp_path / "report.html"), "--baseline", baseline]) == 0
    page = page_of(tmp_path)
    results, _ = report.choose(load_results(known), baseline, None)
    cells = summarise(results)
    for metric in ("mse", "mae"):
        rows = page.figures(metric)
        assert len(rows) == len(cells) == 8
        for row, cell in zip(rows, cells, strict=True):
            expected = {"metric": metric, "runs": cell.runs, "spp": cell.samples.mean}
            expected["efficiency"] = cell.efficiency[metric]
            named = {"error": cell.errors[metric], "time": cell.seconds}
            if cell.method != baseline:
                named["speed-up"] = cell.speed_up[metric]
            for name, figure in named.items():
                expected |= {name: figure.mean, f"{name} low": figure.low, f"{name} high": figure.high}
            assert row == expected
    # What is seen of a value is its first three digits.
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for value, shown in re.findall(r'data-value="([^"]+)"[^>]*>(?:<strong>)?([^<]+)<', text):
        assert float(f"{float(value):.2e}") == float(shown)


def test_the_metric_that_is_shown_first(known, tmp_path):
    assert report.main([str(known), "-o", str(tmp_path / "report.html"), "--metric", "mae"]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text.count('data-metric="mse" hidden') == text.count('data-metric="mse"') == 2
    assert 'data-metric="mae" hidden' not in text
    assert '<option value="mae" selected>' in text


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, "0"),
        (0.016349, "0.0163"),
        (1234.0, "1230"),
        (0.5, "0.5"),
        (-3.0, "-3"),
        (1e-5, "10⁻⁵"),
        (2.5e7, "2.5·10⁷"),
        (1.234e-12, "1.23·10⁻¹²"),
    ],
)
def test_numbers(value, words):
    assert number(value) == words


# --- plots -------------------------------------------------------------------------------------------------------


def test_curves_by_hand(known):
    results = load_results(known)
    slow, fast = curves(results, summarise(results), "room", "mse")
    assert [place.samples for place in slow.way] == [1, 2, 4, 8, 16]  # of the larger budget alone
    assert [place.seconds for place in fast.way] == pytest.approx([0.375 * n for n in (1, 2, 4, 8, 16)])
    assert [place.error.mean for place in fast.way] == pytest.approx([0.24 / n for n in (1, 2, 4, 8, 16)])
    assert slow.way[1].error.high == pytest.approx((1.2 + 12.7062047 * 0.4) / 2.0)
    assert [label for label, _ in slow.ends] == ["4 spp", "16 spp"]
    assert slow.ends[1][1] == slow.way[-1]


def test_a_point_counts_only_if_all_runs_have_it(known):
    """Runs with budgets in seconds end at different samples."""
    results = load_results(known)
    run = next(record for record in results.records if record.method == "slow" and record.samples == 16)
    del run.points[3]
    (slow, _) = curves(results, summarise(results), "room", "mse")
    assert [place.samples for place in slow.way] == [1, 2, 4, 16]


def coordinates(path: str) -> np.ndarray:
    return np.array([[float(x) for x in point.split()] for point in path.strip("MZ").split("L")])


def test_the_plot_is_logarithmic(known):
    """Errors that fall with 1/N are on a line, equal steps of log N are equal steps, and mark and line end together."""
    results = load_results(known)
    drawn = svg(curves(results, summarise(results), "room", "mse"), "samples", "mse", "title")
    lines = [coordinates(path) for path in re.findall(r'class="line"[^>]* d="([^"]+)"', drawn)]
    assert len(lines) == 2
    for line in lines:
        steps = np.diff(line, axis=0)
        np.testing.assert_allclose(steps, steps[:1].repeat(4, axis=0), atol=0.11)  # one digit is written
        assert steps[0, 0] > 10.0 and steps[0, 1] > 10.0  # to the right, and down
    np.testing.assert_allclose(lines[0][:, 0], lines[1][:, 0])
    # The ratio of the errors is 5 everywhere, in units of the step for a factor of 2.
    assert (lines[1] - lines[0])[:, 1] / np.diff(lines[0], axis=0)[0, 1] == pytest.approx(math.log2(5.0), abs=0.02)
    marks = re.findall(r'class="mark" transform="translate\(([^)]+)\)', drawn)
    assert marks[1] == "{:.1f} {:.1f}".format(*lines[0][-1])
    band = coordinates(re.search(r'class="band" d="([^"]+)"', drawn)[1])
    assert len(band) == 10
    assert (band[:5, 1] < lines[0][:, 1]).all() and (band[:4:-1, 1] > lines[0][:, 1]).all()


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0.5, 2000.0, [1, 10, 100, 1000]),
        (0.9, 70.0, [1, 2, 5, 10, 20, 50]),
        (1.1, 3.2, [1.5, 2, 3]),
        (1.101, 1.102, [1.101]),
    ],
)
def test_ticks(low, high, ticks):
    assert LogAxis(low, high, 0.0, 1.0).ticks() == pytest.approx(ticks)


def test_axis():
    axis = LogAxis(0.1, 1000.0, 10.0, 400.0)
    assert [axis(x) for x in (0.1, 1.0, 1000.0, -5.0, 1e9)] == pytest.approx([10.0, 110.0, 410.0, 10.0, 410.0])


def test_errors_of_zero_leave_no_plot(known):
    results = load_results(known)
    for record in results.records:
        record.errors = {"mse": 0.0, "mae": 0.0}
        record.points = []
    cells = summarise(results)
    found = curves(results, cells, "room", "mse")
    assert "nothing to draw" in svg(found, "seconds", "mse", "room")
    page, _ = report.make_page(results, cells, "mse", {}, "none")
    assert "nothing to draw" in page


def test_png_plots(known, tmp_path, capsys):
    assert report.main([str(known), "-o", str(tmp_path / "a.html"), "--plots", str(tmp_path / "plots")]) == 0
    paths = sorted((tmp_path / "plots").iterdir())
    assert [path.name for path in paths] == ["box.png", "room.png"]
    assert str(paths[0]) in capsys.readouterr().out
    pixels = np.asarray(Image.open(paths[0]).convert("RGB"))
    assert pixels.shape == (630, 1500, 3)
    for colour in COLOURS[:2]:  # both methods are drawn in both halves
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        found = (pixels == rgb).all(axis=2)
        assert found[:, :750].sum() > 100 and found[:, 750:].sum() > 100


# --- images ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e7])
@pytest.mark.parametrize("channels", [1, 3])
def test_rounding_of_pixels(scale, channels):
    """The stated errors hold over 60 powers of two, and the relative one is nearly reached."""
    rng = np.random.default_rng(1)
    pixels = scale * np.exp2(rng.uniform(-40.0, 20.0, (40, 30, channels))) * rng.choice([-1.0, 1.0], (40, 30, channels))
    pixels[3, 4] = 0.0
    text, exponent = encode(pixels)
    back = decode(text, exponent, 40, 30)
    allowed = np.maximum(RELATIVE_ERROR * np.abs(pixels), ABSOLUTE_ERROR * np.abs(pixels).max())
    assert (np.abs(back - pixels) <= allowed).all()
    assert (np.abs(back - pixels) / np.maximum(np.abs(pixels), 1e-300)).max() > 0.9 * RELATIVE_ERROR
    assert (back[3, 4] == 0.0).all()


@pytest.mark.parametrize("value", [0.0, 1.0, 65504.0, 2.0**15 - 1e-9, np.nextafter(1.0, 0.0), 3e38])
def test_largest_value_stays_finite(value):
    text, exponent = encode(np.full((2, 3, 3), value))
    np.testing.assert_allclose(decode(text, exponent, 2, 3), value, rtol=RELATIVE_ERROR)


def test_images_of_the_page(known):
    page = page_of(known)
    data = json.loads(page.scripts["data"])
    assert [scene["name"] for scene in data["scenes"]] == ["room", "box"]
    assert data["metrics"] == ["mse", "mae", "relmse", "mrse", "mape", "smape"]
    for scene in data["scenes"]:
        assert len(scene["images"]) == 4
        for entry in scene["images"]:
            method, spp = data["methods"][entry["method"]], (4, 16)[entry["budget"]]
            made = radiance(f"{scene['name']} {method} {spp}", scene["width"], scene["height"])
            text = page.scripts[f"pixels-{entry['pixels']}"]
            back = decode(text, entry["exponent"], scene["height"], scene["width"])
            np.testing.assert_allclose(back, made, rtol=RELATIVE_ERROR)
            assert entry["errors"]["mse"] == {"slow": 1.6, "fast": 0.4}[method] / spp


def test_choice_of_images(known, tmp_path):
    found = {}
    for choice in ("all", "largest", "none"):
        (tmp_path / choice).mkdir()
        assert report.main([str(known), "-o", str(tmp_path / choice / "report.html"), "--images", choice]) == 0
        scenes = json.loads(page_of(tmp_path / choice).scripts["data"])["scenes"]
        found[choice] = [sorted((e["method"], e["budget"]) for e in scene["images"]) for scene in scenes]
    assert found["all"] == [[(0, 0), (0, 1), (1, 0), (1, 1)]] * 2
    assert found["largest"] == [[(0, 1), (1, 1)]] * 2
    assert found["none"] == []


def test_flip_is_stored(tmp_path):
    flip = pytest.importorskip("flip_evaluator", reason="the FLIP metric needs the package flip-evaluator")
    assert flip
    from tools.metrics import error_map

    folder = write_results(tmp_path / "results", {"room": (24, 16)}, metrics=("flip", "mse"))
    assert report.main([str(folder)]) == 0
    page = page_of(folder)
    data = json.loads(page.scripts["data"])
    assert data["metrics"][0] == "flip"
    entry = data["scenes"][0]["images"][0]["flip"]
    back = decode(page.scripts[f"pixels-{entry['pixels']}"], entry["exponent"], 16, 24)[..., 0]
    reference = load_results(folder).reference("room").image
    expected = error_map("flip", radiance("room slow 4", 24, 16), reference)
    np.testing.assert_allclose(back, expected, rtol=RELATIVE_ERROR, atol=ABSOLUTE_ERROR)


# --- one file, whatever the names --------------------------------------------------------------------------------


def test_names_are_escaped(tmp_path):
    """Names that are HTML stay text, in the markup and in the data; tags and scripts are those of harmless names."""
    evil = '</script><b onclick="x">&amp;'
    folder = write_results(
        tmp_path / "evil", {f"a{evil}": (6, 5)}, ("first", f"b{evil}", "c'$x$\\"), description=f"d{evil}$"
    )
    plain = write_results(tmp_path / "plain", {"a": (6, 5)}, ("first", "b", "c"), description="d")
    for one in (folder, plain):
        words = ["--crop", f"e{evil}=2x2+0+0"] if one is folder else ["--crop", "e=2x2+0+0"]
        assert report.main([str(one), *words, "--plots", str(one / "plots")]) == 0
    page = page_of(folder)
    assert page.tags == page_of(plain).tags
    data = json.loads(page.scripts["data"])
    assert data["methods"] == ["first", f"b{evil}", "c'$x$\\"]
    assert data["scenes"][0]["crops"][0]["name"] == f"e{evil}"
    assert page.words.count(f"b{evil}") >= 5
    assert f"d{evil}$" in page.words
    assert evil not in (folder / "report.html").read_text(encoding="utf-8")


def test_nothing_comes_from_elsewhere(known):
    text = (known / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?:|//[a-z]+\.|\bsrc=|\bhref=|@import|url\(", html.unescape(text))
    assert "default-src 'none'" in text
    for part in ("$title", "$data", "$script", "$style"):
        assert part not in text


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--metric", "flip"], "--metric flip: was not measured; allowed: mse, mae"),
        (["--baseline", "quick"], "--baseline quick: is no method of the experiment; allowed: slow, fast"),
        (["--crop", "lamp"], "--crop lamp: allowed: [SCENE:]NAME=WxH+X+Y in pixels"),
        (["--crop", "lamp=0x4+1+1"], "--crop lamp=0x4+1+1: allowed: "),
        (["--crop", "hall:lamp=4x4+1+1"], "there is no scene 'hall'; allowed: room, box"),
        (["--crop", "box:lamp=4x4+7+1"], "crop 'lamp': 4x4+7+1 leaves the image of box, which has 10x14 pixels"),
        (["-o", "missing/report.html"], "missing/report.html: the folder missing does not exist"),
    ],
)
def test_bad_options(known, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(known.rglob("*"))
    output = [] if "-o" in words else ["-o", "report.html"]
    assert report.main([str(known), *output, *words]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]
    assert sorted(known.rglob("*")) == before
    assert list(tmp_path.iterdir()) == []


def _no_experiment(folder):
    (folder / EXPERIMENT).unlink()


def _no_records(folder):
    (folder / RECORDS).unlink()


def _bad_record(folder):
    (folder / RECORDS).write_text('{"scene": 1}\n')


def _no_image(folder):
    (folder / "images" / "room" / "fast" / "4-spp-1.exr").unlink()


def _other_size(folder):
    shape = (folder / "images" / "box" / "fast" / "4-spp-1.exr").read_bytes()
    (folder / "images" / "room" / "fast" / "4-spp-1.exr").write_bytes(shape)


def _other_reference(folder):
    (folder / "references" / "room.exr").write_bytes((folder / "references" / "box.exr").read_bytes())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_no_experiment, "experiment.json: cannot be read: No such file or directory; allowed: results of"),
        (_no_records, "no run has ended yet, so that there is nothing to show"),
        (_bad_record, "results.jsonl: line 1: not a record of a run"),
        (_no_image, "4-spp-1.exr: file not found"),
        (_other_size, "4-spp-1.exr: has 10x14 pixels; the reference has 24x16"),
        (_other_reference, "room.exr: is not the image that room.json tells of"),
    ],
)
def test_damaged_results(tmp_path, capsys, damage, message):
    folder = write_results(tmp_path / "results")
    damage(folder)
    assert report.main([str(folder)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]
    assert not list(folder.glob("*report*"))


def test_results_of_an_experiment_that_still_runs(tmp_path, capsys):
    """A line that is being written is left out, methods without runs are in no table, and the page says how many."""
    folder = write_results(tmp_path / "results", images=False)
    lines = (folder / RECORDS).read_bytes().splitlines(keepends=True)
    (folder / RECORDS).write_bytes(b"".join(lines[:3]) + lines[3][:50])
    assert report.main([str(folder)]) == 0
    assert "3 runs" in capsys.readouterr().out
    page = page_of(folder)
    assert len(page.figures("mse")) == 2
    assert "3 of 16 runs" in page.words
    assert json.loads(page.scripts["data"])["scenes"] == []  # no image was kept: the viewer stays hidden
