"""Memory of the command, as the operating system counts it: what is planned is kept, and no image is copied whole."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from wavefront.film import CHANNELS, Film

SCENE = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
MIB = 1 << 20
# The high-water mark of its own process: that of getrusage may be inherited from the parent.
CHILD = """
import sys
from wavefront.render import main
status = main(sys.argv[1:])
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM:"))
print(status, int(peak) * 1024)
"""
pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")


def run(out, *arguments) -> tuple[int, int, str]:
    """Exit status, peak memory in bytes, and what was printed."""
    command = [sys.executable, "-c", CHILD, str(SCENE), "-o", str(out), "--threads", "2", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    status, peak = map(int, done.stdout.split())
    return status, peak, done.stderr


@pytest.mark.parametrize("aovs", [(), ("variance",)])
def test_a_pixel_takes_its_bytes_and_no_more(tmp_path, aovs):
    """From 1 to 4 million pixels, to within 4 bytes each: a copy of the image as 32-bit floats would be 12."""
    settings = ("--spp", 1, "--max-depth", 1, *(("--aov", ",".join(aovs)) if aovs else ()))
    run(tmp_path / "out.exr", "--size", "16x16", *settings)  # compiles, which takes memory too
    _, small, _ = run(tmp_path / "out.exr", "--size", "1024x1024", *settings)
    _, large, _ = run(tmp_path / "out.exr", "--size", "2048x2048", *settings)
    per_pixel = (large - small) / (2048**2 - 1024**2)
    print(f"{per_pixel:.1f} bytes per pixel")
    assert Film.bytes_per_pixel(aovs) - 4.0 < per_pixel < Film.bytes_per_pixel(aovs) + 4.0


def test_the_budget_that_is_asked_for_is_kept(tmp_path):
    """A budget that is too small is refused with the one that is enough; with that, the peak lies below it."""
    settings = ("--size", "1024x768", "--spp", 2, "--max-depth", 1, "--aov", ",".join(CHANNELS))
    status, _, error = run(tmp_path / "out.exr", *settings, "--memory", "20M")
    assert status == 2
    assert list(tmp_path.iterdir()) == []
    message = re.search(r"too small for 786432 pixels on 2 threads; at least (\d+) MiB is needed, (\d+) MiB", error)
    needed, film = map(int, message.groups())
    assert film == round(1024 * 768 * Film.bytes_per_pixel(tuple(CHANNELS)) / MIB)
    # Not refused for a little more, which is what a process may differ by from one start to the next.
    status, peak, error = run(tmp_path / "out.exr", *settings, "--memory", f"{needed + 8}M")
    assert status == 0
    assert peak < (needed + 8) * MIB
    account = json.loads((tmp_path / "out.json").read_text())
    assert account["bytes_per_pixel"] == Film.bytes_per_pixel(tuple(CHANNELS))
    assert f"{account['bytes_per_pixel']} bytes per pixel, {account['bytes_per_path']} per path" in error
    assert f"{account['paths_in_flight']} paths in flight" in error
    assert account["peak_memory_bytes"] == pytest.approx(peak, abs=MIB)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [("--spp", 1), ("--spp", 2, "--aov", "variance")], ids=["plain", "variance"])
def test_8k_within_2_gib(tmp_path, arguments):
    status, peak, _ = run(tmp_path / "out.exr", "--size", "7680x4320", "--memory", "2G", *arguments)
    print(f"{peak / MIB:.0f} MiB")
    assert status == 0
    assert peak < 2048 * MIB
