"""References as files: what they are of, how they were made, and whether they may be used (see `tools.reference`)."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from tools.image_reader import read_image
from tools.methods import RENDERERS, load_job, scene_name
from wavefront.errors import WavefrontError
from wavefront.identity import explain_differences, scene_hash, scene_records
from wavefront.scene import description

FORMAT = 1
DEFAULT_FOLDER = Path("references")
# Settings of the integrator that change the noise of an image and not its mean. Others that may come are taken to
# change the mean until they are named here.
NOISE_ONLY = ("rr_depth", "nee", "sampler")


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
        error: Relative standard error, see `tools.reference`.
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
        differs = explain_differences(plain(target_records(scene)), self.account.target, "the reference")
        if differs:
            raise WavefrontError(f"{self.path}: is a reference of other settings: {differs}")


def plain(value):
    """A value as it comes back from JSON."""
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


def account_path(image: Path) -> Path:
    """The JSON file beside an image."""
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
        raise WavefrontError(f"{path}: is not the image that {account_path(path).name} tells of; make it again")
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
    path = account_path(image)
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
            others.append(explain_differences(plain(target), account.target, path.name))
    found = "; ".join(others) if others else "it has none of this scene"
    raise WavefrontError(f"{folder}: no reference of {scene_path} with these settings: {found}")
