"""Statistics of experiments against values worked out by hand, and their coverage."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tools import summary
from tools.results import Budget, Experiment, Record, ReferenceEntry, Results, SceneEntry, Seconds
from tools.summary import costs, mean_figure, ratio_figure, summarise


def test_mean_by_hand():
    figure = mean_figure([1.0, 2.0, 3.0])
    # s = 1, t(0.975; 2) = 4.302653, half = t / sqrt(3)
    assert figure.mean == 2.0
    assert figure.high - 2.0 == pytest.approx(4.302653 / math.sqrt(3.0), rel=1e-6)
    assert 2.0 - figure.low == pytest.approx(4.302653 / math.sqrt(3.0), rel=1e-6)
    single = mean_figure([5.0])
    assert single.mean == 5.0
    assert single.plain() == {"mean": 5.0, "low": None, "high": None}
    assert str(single) == "5"


def test_ratio_by_hand():
    # Means 3 and 1; variance of the logarithm (sqrt(2) / 3)^2 / 2 = 1/9 with one degree of freedom: t = 12.7062.
    figure = ratio_figure([2.0, 4.0], [1.0, 1.0])
    assert figure.mean == 3.0
    assert figure.high == pytest.approx(3.0 * math.exp(12.7062047 / 3.0), rel=1e-6)
    assert figure.low == pytest.approx(3.0 / math.exp(12.7062047 / 3.0), rel=1e-6)
    # Both alike: 1/9 + 1/9 with (2/9)^2 / (2/81) = 2 degrees of freedom: t = 4.302653.
    figure = ratio_figure([2.0, 4.0], [20.0, 40.0])
    assert figure.high == pytest.approx(0.1 * math.exp(4.302653 * math.sqrt(2.0) / 3.0), rel=1e-6)
    assert ratio_figure([2.0, 2.0], [1.0, 1.0]) == summary.Figure(2.0, 2.0, 2.0)
    assert math.isnan(ratio_figure([2.0], [1.0]).low)


@pytest.mark.parametrize("what", ["mean", "ratio"])
def test_intervals_cover(what):
    """Of 4,000 experiments of 5 runs, 95 % cover the truth: within 4 standard errors, a false alarm rate of 1e-4; the
    ratio, which is of first order, within 1 % more."""
    rng = np.random.default_rng(1)
    trials = 4000
    a, b = rng.normal(10.0, 1.0, (trials, 5)), rng.normal(4.0, 0.4, (trials, 5))
    if what == "mean":
        truth, figures, slack = 10.0, [mean_figure(x) for x in a], 0.0
    else:
        truth, figures, slack = 2.5, [ratio_figure(x, y) for x, y in zip(a, b, strict=True)], 0.01
    covered = np.mean([figure.low <= truth <= figure.high for figure in figures])
    assert abs(covered - 0.95) < slack + stats.norm.isf(5e-5) * math.sqrt(0.95 * 0.05 / trials)


def record(method: str, seed: int, error: float, seconds: float, notes=()) -> Record:
    times = Seconds(load=1.0, compile=2.0, render=seconds, training=0.5, measure=0.0, write=0.0, other=0.0, total=9.0)
    return Record(
        scene="room",
        method=method,
        budget=Budget(seconds=2.0),
        seed=seed,
        renderer_seed=seed,
        samples=64 * seed,
        seconds=times,
        errors={"relmse": error, "mae": math.sqrt(error)},
        points=[],
        image=None,
        made={},
        notes=list(notes),
        account={},
    )


def results(records: list[Record]) -> Results:
    reference = ReferenceEntry(image="r.exr", sha256="", renderer="wavefront", samples=1, error=0.1)
    scene = SceneEntry(
        name="room", file="", width=1, height=1, overrides=[], parameters={}, target_sha256="", reference=reference
    )
    return Results(
        Path(),
        Experiment(
            format=1,
            name="test",
            description="",
            scenes=[scene],
            methods=[],
            budgets=[Budget(seconds=2.0)],
            seeds=[1, 2],
            metrics=["relmse", "mae"],
            baseline="slow",
            threads=1,
            device="cpu",
            machine={"cpu": "abacus"},
            commit=None,
            date="",
            spec={},
        ),
        records,
    )


def test_summary_by_hand():
    records = [record("slow", 1, 0.4, 2.0), record("slow", 2, 0.2, 2.0)]
    records += [record("fast", 1, 0.1, 1.0), record("fast", 2, 0.02, 2.0), record("short", 1, 0.01, 1.0, ["other"])]
    slow, fast, short = summarise(results(records))
    np.testing.assert_allclose(costs(records[:2], "relmse"), [0.8, 0.4])
    np.testing.assert_allclose(costs(records[2:4], "mae"), [0.1, 0.04])  # no square: it counts squared
    # Less a floor of 0.1^2, the errors of relmse are 0.39, 0.19, 0.09 and 0.01, their costs 0.78, 0.38, 0.09 and 0.02.
    assert slow.efficiency["relmse"] == pytest.approx(1.0 / 0.58)
    assert fast.efficiency["relmse"] == pytest.approx(1.0 / 0.055)
    assert fast.efficiency["mae"] == pytest.approx(1.0 / 0.07)
    assert fast.speed_up["relmse"].mean == pytest.approx(0.58 / 0.055)
    assert fast.error_ratio["relmse"].mean == pytest.approx(0.29 / 0.05)
    assert fast.error_ratio["mae"].mean == pytest.approx(
        (math.sqrt(0.4) + math.sqrt(0.2)) / (math.sqrt(0.1) + math.sqrt(0.02))
    )
    # Relative variances of the means of costs: (0.2 sqrt 2 / 0.58)^2 / 2 and (0.035 sqrt 2 / 0.055)^2 / 2.
    parts = [(0.2 / 0.58) ** 2, (0.035 / 0.055) ** 2]
    degrees = sum(parts) ** 2 / sum(part**2 for part in parts)
    factor = math.exp(stats.t.ppf(0.975, degrees) * math.sqrt(sum(parts)))
    assert fast.speed_up["relmse"].high == pytest.approx(0.58 / 0.055 * factor)
    assert fast.speed_up["relmse"].low == pytest.approx(0.58 / 0.055 / factor)
    assert slow.speed_up == {}
    assert (short.speed_up, short.notes) == ({}, ["other"])
    assert (slow.runs, slow.overhead, slow.training) == (2, 3.0, 0.5)
    assert slow.samples.mean == 96.0
    assert slow.floor == {"relmse": pytest.approx(0.01)}


def test_remarks_name_what_a_reader_must_know():
    made = results([record("slow", 1, 0.02, 2.0), record("short", 1, 0.5, 1.0, ["other"])])
    lines = summary.remarks(made, summarise(made))
    assert lines[0] == "* short, room: other"
    assert lines[1].startswith("room: up to 50 % of a relMSE is the noise of the reference")
    text = summary.markdown(made, summarise(made))
    assert text.count("| room | 2 s |") == 2
    assert "| short * |" in text
    for verdict, words in (("same", []), ("noisy", ["are too noisy to be compared"]), ("differs", ["differ"])):
        made.experiment.scenes[0].reference.comparisons[:] = [{"verdict": verdict}]
        found = summary.remarks(made, summarise(made))[len(lines) :]
        assert found == [f"room: the references of two renderers {word}" for word in words]
