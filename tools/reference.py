"""References: the image of a scene with its variance, rendered until its error is small, and an account of its making.

    python -m tools.reference SCENE [--override integrator.max_depth=8 …] [--error E] [--spp N] [--seconds S]

renders until the first of the limits is reached (none given: `--error 0.01`) and writes, in the folder `--output`,
``NAME-HASH.wavefront.exr`` with the channels R, G, B and variance.Y (the estimated variance of the mean luminance of
each pixel), and the same name with ``.json``: settings, seed, versions, samples, seconds, error. The *relative standard
error* E is the root of the mean over pixels of variance.Y / (Y^2 + 0.01). E^2 is what the reference itself has of
relMSE (of luminance) in the mean, and so what it adds to the relMSE that is measured with it.

With `--with mitsuba`, Mitsuba 3 renders it, an independent renderer: ``NAME-HASH.mitsuba.exr``, the variance from the
spread of batches with seeds of their own. When both exist they are compared (see `tools.bias_test`; exit status 1 if
they differ), and ``NAME-HASH.comparison.json`` says how.

HASH is of all that the expected image depends on: the scene with its files, film, depth. Next-event estimation, Russian
roulette and the sampler change the noise alone, and are no part of it. A reference that is there is used if it is good
enough; for stricter limits it is continued. A render that is killed goes on from its last checkpoint when the command
is repeated.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import hashlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console

from tools.bench_common import machine
from tools.bias_test import BiasTest, find_bias
from tools.image_reader import read_image
from tools.image_test import RATIO_TOLERANCE
from tools.methods import RENDERERS, Job, load_job, scene_name
from tools.reference_render import MAKERS, Goal, median_relative_error, relative_error, render
from wavefront.errors import WavefrontError
from wavefront.identity import explain_differences, scene_hash, scene_records
from wavefront.output import check_writable
from wavefront.scene import description
from wavefront.scene.images import replacing

FORMAT = 1
DEFAULT_FOLDER = Path("references")
DEFAULT_ERROR = 0.01
# Settings of the integrator that change the noise of an image and not its mean. Others that may come are taken to
# change the mean until they are named here.
NOISE_ONLY = ("rr_depth", "nee", "sampler")
NOISY = 0.02  # width of an interval that says nothing


class Account(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """How a reference was made: the JSON file beside it.

    Attributes:
        format: Of this file.
        image: Name of the EXR file.
        image_sha256: Of its bytes.
        scene: Name of the scene.
        file: The scene file, as given.
        overrides: Of the scene's settings.
        parameters: Of a Mitsuba file.
        renderer: A key of `tools.methods.RENDERERS`.
        versions: Of the renderer.
        seed: Of the random numbers.
        settings: Film and integrator.
        target: All that the expected image depends on, see `target_records`.
        target_sha256: Of `target`.
        samples_per_pixel: In the image.
        seconds: Wall time of rendering, loading and compiling apart.
        error: Relative standard error, see the head of this module.
        median_error: Median over lit pixels of standard error over luminance.
        requested: The limits: ``error``, ``spp``, ``seconds``; null: none.
        reached: Whether `error` is as small as requested; null where no error was.
        details: Further figures of the renderer.
        machine: It ran on.
        date: It ended, UTC.
    """

    format: int
    image: str
    image_sha256: str
    scene: str
    file: str
    overrides: list[str]
    parameters: dict[str, str]
    renderer: str
    versions: dict[str, str]
    seed: int
    settings: dict
    target: dict
    target_sha256: str
    samples_per_pixel: int
    seconds: float
    error: float
    median_error: float
    requested: dict
    reached: bool | None
    details: dict
    machine: dict
    date: str


@dataclasses.dataclass
class Reference:
    """A reference.

    Attributes:
        path: The EXR file.
        image: Mean radiance, [height, width, 3] float32.
        variance: Estimated variance of the mean luminance, [height, width] float32.
        account: How it was made.
    """

    path: Path
    image: np.ndarray
    variance: np.ndarray
    account: Account

    def check(self, scene: description.Scene) -> None:
        """Refuses to be the reference of another scene or other settings.

        Raises:
            WavefrontError: Lists the differences.
        """
        differs = explain_differences(_plain(target_records(scene)), self.account.target, "the reference")
        if differs:
            raise WavefrontError(f"{self.path}: is a reference of other settings: {differs}")


def _plain(value):
    return json.loads(json.dumps(value))


def target_records(scene: description.Scene) -> dict:
    """All that the expected image of a scene depends on, as plain values: `identity.scene_records` without AOVs and
    without the settings of the integrator that change the noise alone.

    Lights without extent are found by next-event estimation alone, so in their presence it is part of the target.
    """
    records = scene_records(scene)
    records["film"].pop("aovs", None)
    unseen = (description.Directional, description.Point, description.Spot)
    for key in NOISE_ONLY:
        if key != "nee" or not any(isinstance(emitter, unseen) for emitter in scene.emitters):
            records["integrator"].pop(key, None)
    return records


def reference_path(folder: Path, name: str, target_sha256: str, renderer: str) -> Path:
    """The EXR file of a reference."""
    return Path(folder) / f"{name}-{target_sha256[:12]}.{renderer}.exr"


def _account_path(image: Path) -> Path:
    return image.with_suffix(".json")


# --- reading -----------------------------------------------------------------------------------------------------


def load_reference(path: str | os.PathLike, scene: description.Scene | None = None) -> Reference:
    """Reads a reference.

    Args:
        path: Its EXR file.
        scene: What it is to be a reference of; None: whatever it is of.

    Raises:
        WavefrontError: A missing or damaged file, files that do not belong together, or other settings than `scene`,
            with what differs.
    """
    path = Path(path)
    account = read_account(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be read: {error.strerror or error}") from None
    if hashlib.sha256(data).hexdigest() != account.image_sha256:
        raise WavefrontError(f"{path}: is not the image that {_account_path(path).name} tells of; make it again")
    image = read_image(path)
    if image.variance is None or image.variance.shape[2] != 1:
        raise WavefrontError(f"{path}: not a reference: it needs the channel variance.Y; {image.note}")
    reference = Reference(path, image.pixels, image.variance[..., 0], account)
    if scene is not None:
        reference.check(scene)
    return reference


def read_account(image: Path) -> Account:
    """The account beside an image.

    Raises:
        WavefrontError: It is missing or damaged.
    """
    path = _account_path(image)
    if not image.is_file():
        raise WavefrontError(f"{image}: file not found")
    try:
        account = msgspec.json.decode(path.read_bytes(), type=Account)
    except OSError as error:
        raise WavefrontError(f"{path}: cannot be read: {error.strerror or error}") from None
    except msgspec.MsgspecError as error:
        raise WavefrontError(f"{path}: not the account of a reference: {error}") from None
    if account.format != FORMAT:
        raise WavefrontError(f"{path}: format {account.format}; this version reads {FORMAT}")
    return account


def find_reference(
    scene_path: str | os.PathLike,
    overrides: Sequence[str] = (),
    parameters: dict[str, str] | None = None,
    folder: str | os.PathLike = DEFAULT_FOLDER,
    renderer: str | None = None,
) -> Reference:
    """The reference of a scene with these settings.

    Args:
        scene_path: The scene file.
        overrides: Of its settings, as for `load_scene`.
        parameters: Of a Mitsuba file.
        folder: Where references are.
        renderer: That made it; None: ours, or else any.

    Raises:
        WavefrontError: There is none; lists in what those of this scene that are there differ.
    """
    job = load_job(Path(scene_path), overrides, parameters, threads=1)
    name, target = scene_name(scene_path), target_records(job.scene)
    for one in [renderer] if renderer else RENDERERS:
        path = reference_path(Path(folder), name, scene_hash(target), one)
        if path.exists():
            return load_reference(path, job.scene)
    others = []
    for path in sorted(Path(folder).glob(f"{name}-*.exr")):
        account = read_account(path)
        if renderer in (None, account.renderer):
            others.append(explain_differences(_plain(target), account.target, path.name))
    found = "; ".join(others) if others else "it has none of this scene"
    raise WavefrontError(f"{folder}: no reference of {scene_path} with these settings: {found}")


# --- making ------------------------------------------------------------------------------------------------------


def make_reference(
    job: Job,
    goal: Goal,
    folder: Path,
    renderer: str = "wavefront",
    seed: int = 0,
    every: float = 60.0,
    console: Console | None = None,
) -> Reference:
    """The reference of a job: the one that is there if it is good enough; else it is rendered, or continued.

    Args:
        job: What to render.
        goal: When to stop.
        folder: Of references; made if missing.
        renderer: A key of `RENDERERS`.
        seed: Of the random numbers.
        every: Seconds between checkpoints.
        console: For progress; None: none.

    Raises:
        WavefrontError: A renderer that cannot render the job, a reference that was made otherwise (another seed, say),
            or a file that cannot be written.
        KeyboardInterrupt: After Ctrl-C or SIGTERM, when the checkpoint is written.
    """
    if renderer not in MAKERS:
        raise WavefrontError(f"unknown renderer {renderer!r} of references; allowed: {', '.join(MAKERS)}")
    RENDERERS[renderer].check(job)
    if getattr(job.scene.integrator, "sampler", "independent") != "independent":
        raise WavefrontError(
            f"integrator.sampler is {job.scene.integrator.sampler!r}; references take independent samples, whose variance "
            "is known"
        )
    target = target_records(job.scene)
    path = reference_path(folder, scene_name(job.path), scene_hash(target), renderer)
    settings = _plain(
        {
            "film": msgspec.to_builtins(msgspec.structs.asdict(job.scene.film)),
            "integrator": msgspec.to_builtins(msgspec.structs.asdict(job.scene.integrator)),
        }
    )
    settings["integrator"].pop("spp", None)
    settings["film"].pop("aovs", None)
    if path.exists() and _account_path(path).exists():
        there = _reuse(path, goal, {"seed": seed, "settings": settings})
        if there is not None:
            return there
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(path)
    maker = MAKERS[renderer](job, seed)
    render(maker, goal, path.with_suffix(".checkpoint"), every, console)
    image, variance = maker.estimate()
    error = relative_error(image, variance)
    maker.write(path)
    account = Account(
        format=FORMAT,
        image=path.name,
        image_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        scene=scene_name(job.path),
        file=str(job.path),
        overrides=list(job.overrides),
        parameters=dict(job.parameters),
        renderer=renderer,
        versions=RENDERERS[renderer].versions(job.device),
        seed=seed,
        settings=settings,
        target=_plain(target),
        target_sha256=scene_hash(target),
        samples_per_pixel=maker.samples,
        seconds=maker.seconds,
        error=error,
        median_error=median_relative_error(image, variance),
        requested=dataclasses.asdict(goal),
        reached=None if goal.error is None else error <= goal.error,
        details=maker.details(),
        machine=machine(),
        date=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    )
    with replacing(_account_path(path)) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(account), indent=2) + b"\n")
    return load_reference(path, job.scene)


def _reuse(path: Path, goal: Goal, made: dict) -> Reference | None:
    """The reference at `path` if it is good enough, None if it is to be continued.

    Raises:
        WavefrontError: It was made otherwise.
    """
    account = read_account(path)
    differs = explain_differences(made, {"seed": account.seed, "settings": account.settings}, path.name)
    if differs:
        raise WavefrontError(f"{path}: is there, made otherwise: {differs}; choose another folder or remove it")
    if not goal.reached(account.samples_per_pixel, account.seconds, account.error):
        return None
    try:
        return load_reference(path)
    except WavefrontError:  # killed between its image and its account; the checkpoint has the samples
        return None


# --- two renderers -----------------------------------------------------------------------------------------------


def compare_references(a: Path, b: Path) -> tuple[BiasTest, str]:
    """Tests whether two references are of one image, see `tools.bias_test`.

    Returns:
        The test of `a` against `b`, and the verdict: ``differs`` if a tile does at the false alarm rate of the test, or
        if the 95 % interval of the ratio of means does not meet 1 ± 0.005; else ``noisy`` if that is wider than 0.02,
        or ``same``.
    """
    test = find_bias(read_image(a), read_image(b))
    low, high = test.ratio()[1] if test.ratio() else (1.0, 1.0)  # of black images
    if test.failing_tiles or low > 1.0 + RATIO_TOLERANCE or high < 1.0 - RATIO_TOLERANCE:
        return test, "differs"
    return test, "noisy" if high - low > NOISY else "same"


def compare_stored(reference: Reference) -> list[dict]:
    """Compares a reference with those of other renderers beside it, and writes the outcome there.

    Returns:
        For each other one: ``images``, ``image_sha256``, ``samples_per_pixel``, ``verdict``, and `BiasTest.figures`.
    """
    account, folder, outcomes = reference.account, reference.path.parent, []
    for renderer in RENDERERS:
        other = reference_path(folder, account.scene, account.target_sha256, renderer)
        if renderer == account.renderer or not other.exists():
            continue
        # Always in the order of the list, whichever was made last.
        pair = sorted((reference, load_reference(other)), key=lambda one: [*RENDERERS].index(one.account.renderer))
        test, verdict = compare_references(*(one.path for one in pair))
        outcomes.append(
            {
                "images": [one.path.name for one in pair],
                "image_sha256": [one.account.image_sha256 for one in pair],
                "samples_per_pixel": [one.account.samples_per_pixel for one in pair],
                "verdict": verdict,
                **test.figures(),
            }
        )
    if outcomes:
        with replacing(folder / f"{account.scene}-{account.target_sha256[:12]}.comparison.json") as temporary:
            temporary.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")
    return outcomes


def in_words(outcome: dict) -> str:
    """A comparison in one line."""
    first, second = outcome["images"]
    rows, columns = outcome["tiles"]
    text = f"{outcome['verdict']}: {first} against {second}: "
    if outcome["ratio_of_means"] is not None:
        low, high = outcome["ratio_interval_95"]
        text += f"ratio of means {outcome['ratio_of_means']:.4f}, 95 % interval {low:.4f} to {high:.4f}; "
    return text + (
        f"{outcome['failing_tiles']} of {rows * columns} tiles differ, smallest corrected p "
        f"{outcome['smallest_p_corrected']:.2g}"
    )


# --- the command -------------------------------------------------------------------------------------------------


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.reference", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene.json, scene.xml, or glTF")
    parser.add_argument(
        "--override", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help="change keys of the scene"
    )
    parser.add_argument(
        "--define", action="extend", nargs="+", default=[], metavar="NAME=VALUE", help="$NAME of a Mitsuba scene"
    )
    parser.add_argument("--error", type=float, metavar="E", help=f"relative standard error; default {DEFAULT_ERROR}")
    parser.add_argument("--spp", type=int, metavar="N", help="samples per pixel, in all")
    parser.add_argument("--seconds", type=float, metavar="S", help="of rendering, in all")
    parser.add_argument("--with", dest="renderer", choices=MAKERS, default="wavefront", help="default: wavefront")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default 0")
    parser.add_argument("-o", "--output", type=Path, default=DEFAULT_FOLDER, metavar="FOLDER", help="of references")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="between checkpoints; default 60")
    parser.add_argument("--threads", type=int, metavar="N", help="default: all cores")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda or cuda:N")
    return parser


def definitions(texts: Sequence[str]) -> dict[str, str]:
    """Values by name from ``NAME=VALUE``.

    Raises:
        WavefrontError: One that is not of this form.
    """
    pairs = [text.partition("=") for text in texts]
    for text, (name, equals, _) in zip(texts, pairs, strict=True):
        if not (name and equals):
            raise WavefrontError(f"--define {text!r}; allowed: NAME=VALUE")
    return {name: value for name, _, value in pairs}


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(arguments: argparse.Namespace) -> int:
    """Makes a reference; returns the exit status: 1 if another renderer's differs.

    Raises:
        WavefrontError: With the one line that the user needs.
    """
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    limits = (arguments.error, arguments.spp, arguments.seconds)
    goal = Goal(*limits) if any(limit is not None for limit in limits) else Goal(error=DEFAULT_ERROR)
    if not arguments.every > 0.0:
        raise WavefrontError(f"--every {arguments.every:g}; allowed: more than 0")
    if arguments.threads is not None and arguments.threads < 1:
        raise WavefrontError(f"--threads {arguments.threads}; allowed: 1 or more")
    job = load_job(
        arguments.scene,
        arguments.override,
        definitions(arguments.define),
        arguments.threads or available_cores(),
        arguments.device,
        lambda message: console.print(f"warning: {message}"),
    )
    reference = make_reference(
        job, goal, arguments.output, arguments.renderer, arguments.seed, arguments.every, console
    )
    account = reference.account
    print(
        f"{reference.path}: {account.samples_per_pixel} spp in {account.seconds:.1f} s; relative standard error "
        f"{account.error:.2g}, median over pixels {account.median_error:.2g}"
    )
    outcomes = compare_stored(reference)
    for outcome in outcomes:
        print(in_words(outcome))
    return int(any(outcome["verdict"] == "differs" for outcome in outcomes))


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, 1 where two renderers differ, or 2 after an error."""
    try:
        return run(build_parser().parse_args(argv))
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
