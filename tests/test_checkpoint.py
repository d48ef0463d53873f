"""Checkpoints: a render that stops anywhere and goes on gives the bits of one that never stopped."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import pkgutil
import random
import resource
import signal
import subprocess
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import warp as wp

import wavefront
from wavefront import Renderer, load_scene
from wavefront.checkpoint import CheckpointError, film_sections, read_checkpoint, write_checkpoint
from wavefront.render import main

CORNELL_BOX = Path(__file__).parent.parent / "scenes" / "cornell-box.json"
AOVS = ["albedo", "normal", "depth", "variance"]
SPP = 6


def renderer(*overrides, **arguments):
    scene = load_scene(CORNELL_BOX, ["film.width=31", "film.height=23", f"film.aovs={json.dumps(AOVS)}", *overrides])
    return Renderer(scene, **({"seed": 5, "threads": 1} | arguments))


def sums(r) -> dict[str, np.ndarray]:
    return {name: array.numpy().copy() for name, array in film_sections(r.film)["film"].items()}


def assert_same(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.fixture(scope="module")
def whole():
    r = renderer()
    r.render(SPP)
    return r


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint after half of the samples."""
    r = renderer()
    r.render(SPP // 2)
    r.save_checkpoint(tmp_path / "half")
    return tmp_path / "half"


@pytest.fixture
def small_files():
    """No file may grow beyond 4 KiB: what a full disk is to the process."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    @contextlib.contextmanager
    def limited():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    return limited()


# --- what is in it -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [{}, {"threads": 2, "memory": 1 << 20}])
def test_the_second_half_gives_the_bits_of_the_whole(whole, checkpoint, arguments):
    r = renderer("integrator.spp=1000", "film.precision=half", **arguments)
    r.load_checkpoint(checkpoint)
    assert r.sample_count == SPP // 2
    r.render(SPP - SPP // 2)
    assert_same(sums(r), sums(whole))
    assert set(sums(whole)) == {"L", "luminance_squared", "albedo", "normal", "depth"}
    for field in ("sample_count", "paths", "rays", "shadow_rays", "nonfinite"):
        assert getattr(r.statistics, field) == getattr(whole.statistics, field)
    assert r.statistics.render_seconds > 0.0 and r.statistics.stage_seconds["intersect"] > 0.0


def test_a_sequence_of_samples_goes_on(tmp_path):
    """Samples of a Sobol sequence belong together: those after the checkpoint are the next ones of it."""
    whole, half = renderer("integrator.sampler=sobol"), renderer("integrator.sampler=sobol")
    whole.render(SPP)
    half.render(SPP // 2)
    half.save_checkpoint(tmp_path / "half")
    r = renderer("integrator.sampler=sobol", threads=2, memory=1 << 20)
    r.load_checkpoint(tmp_path / "half")
    r.render(SPP - SPP // 2)
    assert_same(sums(r), sums(whole))
    message = r'integrator.sampler is null, but "sobol" in the checkpoint'
    with pytest.raises(CheckpointError, match=message):
        renderer().load_checkpoint(tmp_path / "half")


def test_numpy_reads_it_without_pickle(checkpoint):
    with open(checkpoint, "rb") as file, np.load(file, allow_pickle=False) as archive:
        about = json.loads(archive["about.json"])
        assert archive["film/L"].dtype == np.float64 and archive["film/L"].shape == (31 * 23, 3)
    assert about["identity"]["seed"] == 5
    assert about["statistics"]["sample_count"] == SPP // 2


def test_sections_of_any_type_and_length(tmp_path):
    """Room for what later methods save: other sections, types and sizes, beyond one chunk."""
    data = np.random.default_rng(1).integers(0, 2**31, 3_000_001).astype(np.int32)
    sections = {"guide": {"a": wp.array(data, dtype=wp.int32, device="cpu")}, "film": {}}
    write_checkpoint(tmp_path / "c", {"identity": {}, "more": [1.5]}, sections)
    sections["guide"]["a"].zero_()
    assert read_checkpoint(tmp_path / "c", {}, sections)["more"] == [1.5]
    np.testing.assert_array_equal(sections["guide"]["a"].numpy(), data)


def test_no_copy_of_the_film_is_made(tmp_path):
    size = 6_000_000
    sections = {"film": {"L": wp.full(size, wp.vec3d(1.0, 2.0, 3.0), dtype=wp.vec3d, device="cpu")}}
    tracemalloc.start()
    write_checkpoint(tmp_path / "c", {"identity": {}}, sections)
    read_checkpoint(tmp_path / "c", {}, sections)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 24 * size / 2


# --- what is refused ---------------------------------------------------------------------------------------------


def refused(r, path) -> str:
    """The message, after a check that it is one line and that nothing has changed."""
    before = sums(r)
    with pytest.raises(CheckpointError) as caught:
        r.load_checkpoint(path)
    assert_same(sums(r), before)
    assert r.sample_count == 0
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    return str(caught.value)


def test_another_render_is_refused_and_what_differs_is_said(checkpoint, monkeypatch):
    assert "seed is 6, but 5 in the checkpoint" in refused(renderer(seed=6), checkpoint)
    message = refused(renderer("integrator.max_depth=3", "camera.fov=30"), checkpoint)
    assert "scene.integrator.max_depth is 3, but 8 in the checkpoint" in message
    assert "scene.camera.fov is 30.0, but " in message
    assert "film.aovs" in refused(renderer("film.aovs=[]"), checkpoint)
    assert "film.width is 32, but 31 in the checkpoint" in refused(renderer("film.width=32"), checkpoint)
    monkeypatch.setattr(wavefront, "__version__", "9.9.9")
    assert 'wavefront is "9.9.9", but "' in refused(renderer(), checkpoint)


def test_many_differences_are_not_all_listed(checkpoint):
    r = renderer(*(f"shapes[{i}].name=x{i}" for i in range(6)))
    assert refused(r, checkpoint).endswith("; and 2 more differences")


def test_a_file_of_the_scene_that_changed_is_another_scene(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    mesh = json.dumps([{"type": "mesh", "file": str(tmp_path / "a.ply")}])
    r = renderer(f"shapes={mesh}")
    r.save_checkpoint(tmp_path / "c")
    renderer(f"shapes={mesh}").load_checkpoint(tmp_path / "c")
    text = (tmp_path / "a.ply").read_text()
    (tmp_path / "a.ply").write_text(text.replace("0 1 0", "0 2 0"))
    assert "scene.shapes[0].file" in refused(renderer(f"shapes={mesh}"), tmp_path / "c")


def test_other_formats_and_devices_are_refused(checkpoint, tmp_path):
    def edited(change):
        with zipfile.ZipFile(checkpoint) as old, zipfile.ZipFile(tmp_path / "new", "w") as new:
            for name in old.namelist():
                data = old.read(name)
                if name == "about.json":
                    about = json.loads(data)
                    change(about)
                    data = json.dumps(about)
                new.writestr(name, data)
        return tmp_path / "new"

    r = renderer()
    assert "format 2 of checkpoints; this version reads 1" in refused(r, edited(lambda a: a.update(format=2)))
    change = edited(lambda a: a["identity"].update(device="cuda"))
    assert 'device is "cpu", but "cuda" in the checkpoint' in refused(r, change)
    r.load_checkpoint(edited(lambda a: None))


def test_a_checkpoint_replaces_no_samples(checkpoint):
    r = renderer()
    r.render(1)
    with pytest.raises(wavefront.WavefrontError, match="before the first sample"):
        r.load_checkpoint(checkpoint)


def test_damaged_files_are_one_line_and_change_nothing(checkpoint, tmp_path):
    """Cut off anywhere, or one byte changed anywhere: refused, or, where the byte means nothing, read as it was."""
    good = checkpoint.read_bytes()
    generator = np.random.default_rng(3)
    bad = tmp_path / "bad"
    r = renderer()
    reference = renderer()
    reference.load_checkpoint(checkpoint)
    for length in (0, 1, 30, len(good) // 2, len(good) - 30, len(good) - 1):
        bad.write_bytes(good[:length])
        assert "not a checkpoint, or a damaged one" in refused(r, bad)
    # In headers and directory as well as in the data, which takes most of the file.
    places = [*range(0, 60), *generator.integers(0, len(good), 60), *range(len(good) - 300, len(good), 3)]
    empty, messages = sums(r), []
    for place in places:
        bad.write_bytes(good[:place] + bytes([good[place] ^ (1 << generator.integers(8))]) + good[place + 1 :])
        try:
            r.load_checkpoint(bad)
            assert_same(sums(r), sums(reference))
            r = renderer()
        except CheckpointError as error:
            messages.append(str(error))
            assert_same(sums(r), empty)
    assert all("\n" not in message and message.startswith(f"{bad}: ") for message in messages)
    assert len(messages) > 0.6 * len(places)


def test_missing_and_unreadable_files(tmp_path):
    r = renderer()
    assert "No such file" in refused(r, tmp_path / "none")
    assert "cannot be read" in refused(r, tmp_path)


# --- what goes wrong while it is written --------------------------------------------------------------------------


def test_a_full_disk_leaves_the_last_checkpoint(checkpoint, small_files):
    good = checkpoint.read_bytes()
    r = renderer()
    r.render(1)
    with small_files, pytest.raises(CheckpointError, match="cannot be written: File too large"):
        r.save_checkpoint(checkpoint)
    assert checkpoint.read_bytes() == good
    assert os.listdir(checkpoint.parent) == [checkpoint.name]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_error_of_the_disk_leaves_the_last_checkpoint(checkpoint, monkeypatch, call):
    good = checkpoint.read_bytes()
    r = renderer()

    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(CheckpointError, match="cannot be written: No space left on device"):
        r.save_checkpoint(checkpoint)
    assert checkpoint.read_bytes() == good
    assert os.listdir(checkpoint.parent) == [checkpoint.name]


def test_all_is_on_the_disk_before_the_old_checkpoint_goes(checkpoint, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, n=name, real=real: (calls.append(n), real(*a))[1])
    renderer().save_checkpoint(checkpoint)
    assert calls == ["fsync", "replace", "fsync"]


def test_two_processes_do_not_write_one_checkpoint(checkpoint):
    good = checkpoint.read_bytes()
    temporary = checkpoint.with_name(f".{checkpoint.name}.tmp")
    temporary.write_bytes(b"left by a process that was killed")
    with open(temporary, "r+b") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(CheckpointError, match="another process is writing it"):
            renderer().save_checkpoint(checkpoint)
    assert checkpoint.read_bytes() == good and temporary.read_bytes().startswith(b"left by")
    renderer().save_checkpoint(checkpoint)
    assert os.listdir(checkpoint.parent) == [checkpoint.name]


def test_a_link_stays_a_link(checkpoint, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(checkpoint)
    renderer().save_checkpoint(link)
    assert link.is_symlink()
    renderer().load_checkpoint(checkpoint)


# --- the command -------------------------------------------------------------------------------------------------

SIZE = ("--size", "31x23", "--aov", "albedo,normal,depth,variance", "--threads", 1, "--seed", 5)


def run(capsys, out, *arguments) -> tuple[int, str]:
    """Exit status and what was printed to the error stream."""
    try:
        status = main([str(a) for a in (CORNELL_BOX, "-o", out, *SIZE, *arguments)])
    except SystemExit as exit_:
        status = exit_.code
    return status, capsys.readouterr().err


def read(path) -> dict[str, np.ndarray]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def test_resume_adds_up_to_spp(whole, tmp_path, capsys):
    out, file = tmp_path / "out.exr", tmp_path / "c"
    assert run(capsys, out, "--spp", 2, "--checkpoint", file, "--quiet") == (0, "")
    first = file.read_bytes()
    status, text = run(capsys, out, "--spp", SPP, "--resume", file)
    assert status == 0 and "resuming after 2 samples per pixel" in text
    assert file.read_bytes() == first, "--resume alone only reads"
    assert_same(read(out), whole.film.channels())
    assert json.loads(out.with_suffix(".json").read_text())["paths"] == SPP * 31 * 23


def test_no_samples_more_still_write_the_image(whole, tmp_path, capsys):
    out, file = tmp_path / "out.exr", tmp_path / "c"
    whole.save_checkpoint(file)
    status, text = run(capsys, out, "--spp", 2, "--resume", file)
    assert status == 0 and "holds more samples than the 2 asked for" in text.replace("\n", " ")
    assert_same(read(out), whole.film.channels())


def test_time_counts_from_the_start_of_the_process(whole, tmp_path, capsys):
    out, file = tmp_path / "out.exr", tmp_path / "c"
    whole.statistics.render_seconds, seconds = 1e6, whole.statistics.render_seconds
    whole.save_checkpoint(file)
    whole.statistics.render_seconds = seconds
    assert run(capsys, out, "--time", 0.2, "--resume", file, "--quiet") == (0, "")
    account = json.loads(out.with_suffix(".json").read_text())
    assert account["samples_per_pixel"] > SPP
    assert 1e6 + 0.2 <= account["seconds"]["render"] < 1e6 + 20.0


def test_one_command_begins_and_goes_on(whole, tmp_path, capsys):
    """What a cluster repeats until it is done."""
    out, file = tmp_path / "out.exr", tmp_path / "c"
    for spp in (2, SPP, SPP):
        assert run(capsys, out, "--spp", spp, "--checkpoint", file, "--resume", file, "--quiet") == (0, "")
    assert_same(read(out), whole.film.channels())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--resume", "none"], "none: there is no such checkpoint to resume from"),
        (["--resume", "none", "--checkpoint", "new"], "none: there is no such checkpoint to resume from"),
        (["--checkpoint", "old"], "old: exists; to go on from it, add --resume old; to begin again, remove it"),
        (["--checkpoint", "missing/c"], "missing/c: the folder missing does not exist"),
        (["--checkpoint", "folder", "--resume", "folder"], "folder: cannot be written: it is a folder"),
        (["--checkpoint", "out.exr"], "out.exr: the checkpoint would replace the image; choose another name"),
        (["--every", "3"], "--every is for --checkpoint, which is missing"),
        (["--checkpoint", "new", "--every", "0"], "--every 0; allowed: more than 0"),
        (["--resume", "old"], "old: not a checkpoint, or a damaged one: File is not a zip file"),
    ],
)
def test_bad_arguments_are_one_line(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").write_text("an older file\n")
    (tmp_path / "folder").mkdir()
    status, text = run(capsys, "out.exr", "--quiet", "--spp", 10**9, *arguments)
    assert (status, text) == (2, f"error: {message}\n")
    assert sorted(os.listdir(tmp_path)) == ["folder", "old"]


def test_a_checkpoint_that_fails_stops_nothing(whole, tmp_path, capsys, monkeypatch):
    out, file = tmp_path / "out.exr", tmp_path / "c"
    assert run(capsys, out, "--spp", 1, "--checkpoint", file, "--quiet") == (0, "")
    good = file.read_bytes()

    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    options = ("--spp", SPP, "--checkpoint", file, "--resume", file, "--every", 1e-6)
    status, text = run(capsys, out, *options)
    assert status == 0
    assert text.count("No space left on device; the render goes on, and the last checkpoint is kept") >= 2
    assert file.read_bytes() == good
    assert_same(read(out), whole.film.channels())


def test_an_image_that_cannot_be_written_is_not_lost(whole, tmp_path, capsys, monkeypatch, small_files):
    out = tmp_path / "out.exr"
    # The checkpoint that was asked for has all samples.
    options = ("--spp", SPP, "--quiet")
    monkeypatch.setattr("wavefront.output.write_exr_blocks", lambda *_, **__: 1 / 0)

    def fail(*_, **__):
        raise wavefront.WavefrontError(f"{out}: cannot be written: No space left on device")

    monkeypatch.setattr("wavefront.output.write_exr_blocks", fail)
    status, text = run(capsys, out, *options, "--checkpoint", tmp_path / "c")
    assert status == 2
    assert text == f"error: {out}: cannot be written: No space left on device; nothing is lost: --resume " + (
        f"{tmp_path / 'c'} writes it\n"
    )
    # None was asked for: one is written beside the image, or else in the folder for temporary files.
    status, text = run(capsys, out, *options)
    assert status == 2 and f"nothing is lost: --resume {tmp_path}" in text
    rescued = Path(text.split("--resume ")[1].split(" writes")[0])
    # Nowhere at all.
    with small_files:
        status, text = run(capsys, out, *options)
    assert status == 2 and text.endswith("; and no checkpoint could be written either\n")
    monkeypatch.undo()
    for file in (tmp_path / "c", rescued):
        assert run(capsys, out, *options, "--resume", file) == (0, "")
        assert_same(read(out), whole.film.channels())


# --- processes that end -------------------------------------------------------------------------------------------


def start(out, *arguments):
    command = [sys.executable, "-m", "wavefront.render", str(CORNELL_BOX), "-o", str(out), *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_for(process, word):
    while word not in (line := process.stderr.readline()) and line:
        pass
    assert line, "the process ended early"


def test_killed_at_random_moments(tmp_path):
    """Killed four times, with a checkpoint after every pass so that some kills come while one is written."""
    spp = 200
    options = ("--size", "61x47", "--aov", "albedo,normal,depth,variance", "--spp", spp, "--seed", 7)
    file = tmp_path / "c"
    resumed = ("--checkpoint", file, "--resume", file, "--every", 1e-3)
    moments = random.Random()  # other moments in every run of the test
    kills = 0
    for _ in range(4):
        process = start(tmp_path / "resumed.exr", *options, *resumed)
        try:
            wait_for(process, "rendering")
            time.sleep(moments.uniform(0.0, 0.4))
        finally:
            process.kill()
            _, text = process.communicate()
        kills += process.returncode == -signal.SIGKILL
        assert process.returncode in (0, -signal.SIGKILL), text
    assert kills
    left = sorted(os.listdir(tmp_path))
    assert set(left) <= {"c", ".c.tmp", "resumed.exr", "resumed.png", "resumed.json"}
    process = start(tmp_path / "resumed.exr", *options, *resumed)
    _, text = process.communicate(timeout=120)
    assert process.returncode == 0, text
    assert ".c.tmp" not in os.listdir(tmp_path)
    # By another number of threads, in this process.
    assert main([str(a) for a in (CORNELL_BOX, "-o", tmp_path / "whole.exr", *options, "--threads", 1, "--quiet")]) == 0
    assert_same(read(tmp_path / "resumed.exr"), read(tmp_path / "whole.exr"))
    accounts = [json.loads((tmp_path / f"{name}.json").read_text()) for name in ("resumed", "whole")]
    for key in ("paths", "rays", "shadow_rays", "nonfinite", "samples_per_pixel"):
        assert accounts[0][key] == accounts[1][key]


@pytest.mark.parametrize(
    ("function", "call"),
    [("numpy.lib.format.write_array_header_1_0", 1), ("numpy.lib.format.write_array_header_1_0", 2),
     ("zipfile.ZipFile.close", 1), ("os.fsync", 1), ("os.replace", 1), ("os.fsync", 2)],
)  # fmt: skip
def test_killed_while_writing(checkpoint, monkeypatch, function, call):
    """At each step of it: the file is the old checkpoint or the new one."""
    r = renderer()
    r.render(1)
    module, _, name = function.rpartition(".")
    calls, real = [], getattr(pkgutil.resolve_name(module), name)

    def killed(*arguments, **options):
        calls.append(function)
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments, **options)

    child = os.fork()
    if child == 0:
        monkeypatch.setattr(function, killed)
        with contextlib.suppress(BaseException):
            r.save_checkpoint(checkpoint)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    again = renderer()
    again.load_checkpoint(checkpoint)
    assert again.sample_count == (1 if (function, call) == ("os.fsync", 2) else SPP // 2)
    # What is left of it is in nobody's way.
    r.save_checkpoint(checkpoint)
    assert os.listdir(checkpoint.parent) == [checkpoint.name]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_writes_checkpoint_and_image(tmp_path, number):
    out, file = tmp_path / "out.exr", tmp_path / "c"
    process = start(out, "--size", "31x23", "--time", 120, "--checkpoint", file)
    try:
        wait_for(process, "rendering")
        time.sleep(0.5)
        process.send_signal(number)
        _, text = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 128 + number, text
    with zipfile.ZipFile(file) as archive:
        samples = json.loads(archive.read("about.json"))["statistics"]["sample_count"]
    assert samples == json.loads(out.with_suffix(".json").read_text())["samples_per_pixel"] > 0
