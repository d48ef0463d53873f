"""Blender's path tracer Cycles as a peer, with path guiding (OpenPGL) and without; on the CPU.

    python -m tools.peers.cycles --install

makes an environment of its own for Blender's module `bpy`, which wants one version of Python and packages that this
project does not need. Nothing is installed beside the project.

A render is a process of that environment (`cycles_child`) that holds one scene (`cycles_scene`) and renders samples
when asked to. The same in both renderers: radiance in linear Rec. 709 without any view transform, the length of paths,
next-event estimation, triangles with smooth normals, emission by side, conductors and dielectrics by their Fresnel
equations with single-scattering microfacets, lights without extent. There is no clamping, no filtering of caustics, no
denoising, no adaptive sampling, and the filter is a box. Cycles' own are its random numbers (a Sobol sequence, without
the first sample, which it puts in the middle of the pixel), its selection of lights (a tree), and how Russian roulette
depends on the throughput. Spheres are triangles with exact normals. All else is refused.

What differs: microfacets mask and shadow each other correlated by height in Cycles, separably in ours, so that rough
surfaces are brighter in Cycles: GGX that reflects all light, seen at 60 degrees, by 0.04 % at an alpha of 0.15 and by
1.8 % at 0.5; at 80 degrees by 1 and 8 %. And where a camera or a light is inside of glass, Cycles leaves out that
radiance scales with the squared index of refraction.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from pathlib import Path

import numpy as np

from tools.peers.cycles_scene import FIRST_SAMPLE, MAX_SAMPLES, write_scene
from wavefront.errors import WavefrontError
from wavefront.scene import description
from wavefront.scene.images import load_image

VERSION = "5.2.3"  # of Blender and of `bpy`; one, so that results of two machines are of the same renderer
PYTHON = (3, 13)  # that it is built for
ACCOUNT = "installed.json"
LAST_LINES = 20  # of Blender's that are kept for a message
COMMAND = "python -m tools.peers.cycles --install"


# --- the environment ---------------------------------------------------------------------------------------------


def default_folder() -> Path:
    """Where the environment is: in the folder WAVEFRONT_CYCLES, or else in the user's cache."""
    own = os.environ.get("WAVEFRONT_CYCLES")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wavefront" / f"cycles-{VERSION}"


def missing() -> str | None:
    """Why Cycles cannot be used here, or None where it can."""
    folder = default_folder()
    try:
        found = json.loads((folder / ACCOUNT).read_text(encoding="utf-8"))["blender"]
    except (OSError, ValueError, KeyError, TypeError):
        return f"Cycles is not installed in {folder}; {COMMAND}"
    return None if found == VERSION else f"{folder} has Blender {found}, not {VERSION}; {COMMAND}"


def require() -> Path:
    """The Python of the environment.

    Raises:
        WavefrontError: It is not installed.
    """
    reason = missing()
    if reason is not None:
        raise WavefrontError(reason)
    return _python(default_folder())


def _python(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def find_interpreter(given: str | None = None) -> str:
    """A Python of the version that `bpy` is built for: the given one, that of this process, or one on the PATH.

    Raises:
        WavefrontError: There is none, or the given one is of another version.
    """
    wanted = ".".join(map(str, PYTHON))
    for candidate in [given] if given else [sys.executable, f"python{wanted}", "python3", "python"]:
        path = shutil.which(candidate)
        if path is None:
            continue
        command = [path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        found = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
        if found == wanted:
            return path
        if given:
            raise WavefrontError(f"{given} is Python {found or 'of no version'}; bpy {VERSION} needs {wanted}")
    raise WavefrontError(f"bpy {VERSION} needs Python {wanted}, which was not found; name it with --python")


def install(interpreter: str | None = None, log=print) -> Path:
    """Makes the environment, or leaves the one that is there; what fails or is interrupted leaves nothing.

    Args:
        interpreter: As of `find_interpreter`.
        log: Called with lines for the user.

    Returns:
        Its folder.

    Raises:
        WavefrontError: No such Python, the packages cannot be installed, or this build has no path guiding.
    """
    folder = default_folder()
    if missing() is None:
        log(f"{folder}: Blender {VERSION} is installed already")
        return folder
    if folder.exists() and not (folder / ACCOUNT).is_file():
        raise WavefrontError(
            f"{folder} exists and is not an environment of this tool; remove it, or set WAVEFRONT_CYCLES"
        )
    python, begin = find_interpreter(interpreter), time.perf_counter()
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        log(f"installing bpy {VERSION} with {python} in {folder}; this downloads about 430 MB")
        _run([python, "-m", "venv", temporary], "the environment cannot be made")
        pip = [_python(temporary), "-m", "pip", "install", "--disable-pip-version-check", "--quiet"]
        _run([*pip, f"bpy=={VERSION}"], f"bpy {VERSION} cannot be installed")
        code = "import bpy, _cycles; assert _cycles.with_path_guiding; print(bpy.app.version_string)"
        _run([_python(temporary), "-c", code], "Blender does not start, or has no path guiding")
        size = sum(file.lstat().st_size for file in temporary.rglob("*") if file.is_file() and not file.is_symlink())
        account = {"blender": VERSION, "python": python, "bytes": size, "seconds": time.perf_counter() - begin}
        (temporary / ACCOUNT).write_text(json.dumps(account, indent=2) + "\n", encoding="utf-8")
        if folder.exists():
            shutil.rmtree(folder)  # of another version
        os.replace(temporary, folder)
    except OSError as error:
        raise WavefrontError(f"{folder}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    log(f"{folder}: Blender {VERSION}, {size / 1e6:.0f} MB, {account['seconds']:.0f} s")
    return folder


def _run(command: list, failure: str) -> None:
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise WavefrontError(f"{failure}: {lines[-1] if lines else f'exit status {done.returncode}'}")


# --- a render ----------------------------------------------------------------------------------------------------


class Session:
    """A process that holds a scene. It ends with this object, and with this process.

    Args:
        scene: Valid records.
        guided: With path guiding. Every call of `render` learns anew.
        threads: On the CPU.

    Raises:
        WavefrontError: Cycles is not installed, or it cannot render the scene.
    """

    def __init__(self, scene: description.Scene, guided: bool, threads: int):
        python, film = require(), scene.film
        self.size, self.guided = (film.width, film.height), guided
        folder = tempfile.mkdtemp(prefix="wavefront-cycles-")
        self.folder = Path(folder)
        self._finalizer = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        write_scene(scene, self.folder, guided, threads)
        child = Path(__file__).with_name("cycles_child.py")
        # Without the user's site packages and PYTHONPATH, which are of another Python; not in this process's group,
        # whose interrupts are for this process to hear.
        self.process = subprocess.Popen(
            [str(python), "-I", str(child), folder],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            start_new_session=True,
        )
        self._finalizer.detach()
        self._finalizer = weakref.finalize(self, _end, self.process, folder)
        self.lines: collections.deque[str] = collections.deque(maxlen=LAST_LINES)
        threading.Thread(target=_keep, args=(self.process.stderr, self.lines), daemon=True).start()
        self._answer()

    def close(self) -> None:
        """Ends the process."""
        self._finalizer()

    def warm_up(self) -> None:
        """Renders a tiny image without guiding, so that the scene is built and nothing is learned."""
        self._render(16, 16, 0, 0, 1, False)

    def render(self, samples: int, seed: int, offset: int = 0) -> np.ndarray:
        """The mean of some samples of each pixel.

        Args:
            samples: How many.
            seed: Of the sequence, 0 to 2^31 - 1.
            offset: The first of them in the sequence; `samples` and `offset` make at most `MAX_SAMPLES`.

        Returns:
            [height, width, 3] float32.

        Raises:
            WavefrontError: Out of range, or Cycles failed.
        """
        if samples < 1 or offset < 0 or samples + offset > MAX_SAMPLES or not 0 <= seed < 1 << 31:
            raise WavefrontError(
                f"cycles: samples {offset} to {offset + samples} of seed {seed}; allowed: up to {MAX_SAMPLES} samples, "
                "seeds from 0 to 2^31 - 1"
            )
        return self._render(*self.size, seed, offset, samples, self.guided)

    def _render(self, width: int, height: int, seed: int, offset: int, samples: int, guided: bool) -> np.ndarray:
        file = self.folder / "render.exr"
        request = {
            "width": width,
            "height": height,
            "seed": seed,
            "offset": FIRST_SAMPLE + offset,
            "samples": samples,
            "guided": guided,
            "image": str(file),
        }
        with contextlib.suppress(OSError):  # the answer says what happened
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        self._answer()
        return load_image(file)

    def _answer(self) -> dict:
        line = self.process.stdout.readline()
        try:
            answer = json.loads(line)
        except ValueError:
            status = self.process.wait()
            last = f": {self.lines[-1]}" if self.lines else ""
            raise WavefrontError(f"cycles: Blender ended with status {status}{last}") from None
        if "error" in answer:
            raise WavefrontError(f"cycles: {' '.join(answer['error'].split())}")
        return answer


def _keep(stream, lines: collections.deque) -> None:
    for line in stream:
        if line.strip():
            lines.append(line.strip())


def _end(process: subprocess.Popen, folder: str) -> None:
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):
            stream.close()
    shutil.rmtree(folder, ignore_errors=True)


# --- the command -------------------------------------------------------------------------------------------------


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit status: 0, or 2 after an error, of which one line is printed."""
    parser = argparse.ArgumentParser(prog="python -m tools.peers.cycles", description="Installs Blender's Cycles.")
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--install", action="store_true", help=f"make the environment of bpy {VERSION}")
    group.add_argument("--where", action="store_true", help="print its folder; status 1 if it is not installed")
    parser.add_argument("--python", metavar="PATH", help=f"of version {PYTHON[0]}.{PYTHON[1]}; default: found")
    arguments = parser.parse_args(argv)
    try:
        if arguments.install:
            install(arguments.python)
            return 0
        print(default_folder() if missing() is None else missing())
        return int(missing() is not None)
    except (WavefrontError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
