"""What benchmarks share: the machine they ran on, figures with their spread, and child processes that are measured."""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

from wavefront.errors import WavefrontError

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("wavefront", "warp-lang", "numpy", "embreex", "mitsuba", "drjit", "torch")


def machine() -> dict:
    """What a figure depends on: processor, cores, load, versions."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        # above zero, something else runs, and the figures are too low
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
    }


def require_scipy():
    """The module `scipy.stats`.

    Raises:
        WavefrontError: It is not installed.
    """
    try:
        from scipy import stats
    except ImportError:
        raise WavefrontError("the package scipy is not installed; it comes with pip install '.[measure]'") from None
    return stats


def _cpu_model():
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _version(package):
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def peak_memory_bytes() -> int:
    """Largest resident size of this process.

    On Linux, of this program alone: the figure of `getrusage` also covers what the process was before it became this
    program, a copy of its parent.
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def spread(values: Sequence[float]) -> dict:
    """Median, smallest and largest of the rounds, and the rounds."""
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "rounds": list(values)}


def show(figure: Mapping[str, float], digits: int = 3) -> str:
    """A figure from `spread` as ``median (min to max)``."""
    return "{median:.{d}g} ({min:.{d}g} to {max:.{d}g})".format(d=digits, **figure)


def parse_counts(text: str, fewest: int, most: int) -> list[int]:
    """Numbers such as ``1e3,1e6``.

    Raises:
        argparse.ArgumentTypeError: Says what is allowed.
    """
    try:
        counts = [int(float(part)) for part in text.split(",")]
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers such as 1e3,1e6") from None
    if not all(fewest <= count <= most for count in counts):
        raise argparse.ArgumentTypeError(f"{text}; allowed: {fewest} to {most}")
    return counts


def megabytes(size: float) -> str:
    return f"{size / 2**20:.0f} MiB"


class Child:
    """A Python module in a process of its own, which answers JSON lines with JSON lines (see `serve`).

    Args:
        module: Run as ``python -m module``.
        job: Its one argument, as JSON.
        environment: Variables to add.
    """

    def __init__(self, module: str, job: dict, environment: Mapping[str, str] | None = None):
        self.module = module
        # Warnings of libraries are of interest only if the process fails.
        self.log = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115, see close
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, json.dumps(job)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            cwd=ROOT,
            env={**os.environ, **(environment or {})},
            encoding="utf-8",
        )

    def ask(self, request: dict) -> dict:
        """Sends a request and waits for its answer.

        Raises:
            WavefrontError: The child failed, with its own words.
        """
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # it ended; the answer below says why
        line = self.process.stdout.readline()
        if not line:
            raise WavefrontError(self._last_words())
        answer = json.loads(line)
        if "error" in answer:
            raise WavefrontError(answer["error"])
        return answer

    def _last_words(self):
        status = self.process.wait()
        self.log.seek(0)
        lines = [line.strip() for line in self.log if line.strip()]
        return f"{self.module} ended with status {status}: {lines[-1] if lines else 'no message'}"

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.log):
            stream.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def serve(make) -> None:
    """The child's side: builds a handler from the job and answers requests until there are no more.

    Args:
        make: Called with the job; returns a function from request to answer. A `WavefrontError` is an answer as well.
    """
    # Libraries print to standard output; only answers may.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    handler = None
    for line in sys.stdin:
        try:
            handler = handler or make(json.loads(sys.argv[1]))
            answer = handler(json.loads(line))
        except WavefrontError as error:
            answer = {"error": str(error)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
