"""The figures of `tools.bench_samplers`."""

import json
from pathlib import Path

import numpy as np
import pytest

from tools.bench_samplers import main, order, sample_counts

CORNELL_BOX = str(Path(__file__).parent.parent / "scenes" / "cornell-box.json")


def test_order_of_a_power_law():
    counts = sample_counts(300)
    assert counts == [1, 4, 16, 64, 256, 300]
    errors = [2.0 * n**-0.75 for n in counts]
    errors[0] = 100.0  # before what is fitted
    assert order(counts, errors) == pytest.approx(-0.75)
    assert np.isnan(order([1, 2], [1.0, 0.5]))


def test_account(tmp_path, capsys):
    """Independent samples cost one of themselves; errors are those of the images, which are the same in every run."""
    arguments = [CORNELL_BOX, "--spp", "16", "--seeds", "3", "--size", "8x8", "--set"]
    accounts = []
    for name in ("a", "b"):
        assert main([*arguments, "integrator.max_depth=2", "--json", str(tmp_path / name)]) == 0
        accounts.append(json.loads((tmp_path / name).read_text())["scenes"][0])
    assert "order" in capsys.readouterr().out
    samplers = accounts[0]["samplers"]
    assert accounts[0]["spp"] == [1, 4, 16]
    assert samplers["independent"]["cost"]["median"] == 1.0 and samplers["independent"]["variance_ratio"] == [1.0] * 3
    for name, sampler in samplers.items():
        assert sampler["error"] == accounts[1]["samplers"][name]["error"]
        assert min(sampler["error"]) > 0.0 and sampler["cost"]["min"] > 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "1"], "--seeds 1; allowed: 2 or more"),
        (["--spp", "1"], "--spp 1; allowed: 2 or more"),
        (["none.json"], "none.json: file not found"),
        ([CORNELL_BOX, "--json", "none/out.json"], "none/out.json: the folder none does not exist"),
        ([CORNELL_BOX, "--size", "4x4", "--spp", "2", "--seeds", "2", "--set", "shapes=[]"], "is black"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, message):
    assert main(arguments) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and message in error
