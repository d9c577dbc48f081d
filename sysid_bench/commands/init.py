"""Verbs `init suite` and `init estimator`: a first suite and a first estimator of one's own."""

import keyword
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sysid_bench.commands.request import Request, argument, option, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError

_SUITE: Final = """\
# Written by sysid-bench init suite: one robot, two methods, exact and noisy data.
# Every key of [defaults] may be a list, which is a sweep.
schema = 1
name   = {name}
[run]
repeats = 3                            # noise draws; a guess: enough to see a spread
[defaults]
task       = "robot"                   # or "payload", "link", "terminal"
prior      = {{ mass = "20 %", com = "15 mm", inertia = "30 %" }}   # what methods know
excitation = {{ use = "fourier", harmonics = 5, period = "5 s" }}
held_out   = ["fourier-other"]         # scores come from another motion
noise      = [{{}}, {{ tau = "1 %" }}]     # {{}} is exact; 1 % is a guess: measure yours
signals    = {{ derivatives = "from q", filter = "butter 4 20 Hz zero-phase" }}
[[robot]]
use      = {robot}
payloads = ["none"]
[[estimator]]
use = "ols"
[[estimator]]
use = "wls"
# [[estimator]]
# use = "file:mine.py:Mine"            # sysid-bench init estimator writes one
[[table]]
name    = "main"
rows    = ["robot", "noise"]
columns = ["estimator"]
cells   = {{ metric = "torque_error", stat = "median", interval = "iqr" }}
"""

_ESTIMATOR: Final = '''\
"""Written by sysid-bench init estimator: least squares, to be replaced by a method of one's own."""

from dataclasses import dataclass

import numpy as np

from sysid_bench.types import Estimate, Problem


@dataclass(frozen=True)
class {name}:
    """Least squares on columns of unit norm."""

    # A field is a setting in a suite: use = "file:{file}:{name}", cut = 1e-10.
    cut: float = 1e-12  # smallest singular value that counts, of the largest

    def solve(self, problem: Problem) -> Estimate:
        """Return the base parameters beta of W beta = b, all joints stacked."""
        W, b = problem.W, problem.b
        scale = np.linalg.norm(W, axis=0)
        beta, _, rank, _ = np.linalg.lstsq(W / np.where(scale > 0, scale, 1.0), b, rcond=self.cut)
        if rank < W.shape[1]:
            return Estimate(status="failed", reason=f"the data excite {{rank}} of {{W.shape[1]}}")
        return Estimate(beta / scale)
'''


class InitSuite(Request["InitFileResult"]):
    """Write a suite of one robot and two methods."""

    robot: str | Path = option(
        "A name or a model file.",
        default="ur5", shown=True, complete="robots files",
    )  # fmt: skip
    out: Path = option(
        "File of the suite.",
        default=Path("suite.toml"),
        flags="-o --out",
        shown=True,
        complete="files",
    )
    force: bool = False

    def run(self) -> "InitFileResult":
        """Write a first suite for a robot: its name, or a model file.

        Raises UsageError for an unknown robot and for an existing file without `force`.
        """
        from sysid_bench.input_files import is_file
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.manifest import find_manifest
        from sysid_bench.models.sources import source_settings, with_settings

        target = Path(self.out)
        load_robot(find_manifest(str(self.robot)))
        plain, settings = source_settings(str(self.robot))
        path = Path(plain)
        use = f"file:{relative_to(path, target.parent)}" if is_file(path) else plain
        use = with_settings(use, settings)
        text = _SUITE.format(name=toml_value(target.stem), robot=toml_value(use))
        write_new(target, text, self.force)
        return InitFileResult(file=str(target), next=f"sysid-bench plan {target}")


init_suite = python_function(InitSuite, "init_suite")


class InitEstimator(Request["InitFileResult"]):
    """Write an estimator of one's own, with the class NAME."""

    name: str = argument("[NAME]", default="Mine")
    out: str | Path | None = option(
        "File of the estimator. Default: name.py.",
        default=None,
        flags="-o --out",
        path="new",
        complete="files",
    )
    force: bool = False

    def run(self) -> "InitFileResult":
        """Write a first estimator: a class `name` in the file `out` (default: name.py).

        Raises UsageError for a name that no class can have, and for an existing file without
        `force`.
        """
        if not self.name.isidentifier() or keyword.iskeyword(self.name):
            raise UsageError(
                f"An estimator is a class: {self.name!r} cannot be its name; write 'Mine'."
            )
        target = Path(f"{self.name.lower()}.py" if self.out is None else self.out)
        write_new(target, _ESTIMATOR.format(name=self.name, file=target.name), self.force)
        command = f"sysid-bench check-plugin --kind estimator file:{target}:{self.name}"
        return InitFileResult(file=str(target), next=command)


init_estimator = python_function(InitEstimator, "init_estimator")


@dataclass(frozen=True, eq=False, repr=False)
class InitFileResult(Result):
    """Written file, and the command to run next."""

    file: str
    next: str

    def summary(self) -> str:
        """File, and the command to run next."""
        return f"{self.file} written\n  next: {self.next}"


# --- First files --------------------------------------------------------------------------------


def relative_to(path: Path, folder: Path) -> str:
    """Return a path as a file in `folder` names it: relative where it lies below or beside it."""
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return str(path.resolve()) if relative.startswith(f"..{os.sep}..") else relative


def write_new(path: Path, text: str, force: bool) -> None:
    """Write a text file, and its folder; raise UsageError for an existing one without `force`, or
    for one that cannot be written."""
    # A dangling link does not exist, and writing would make a file elsewhere.
    if not force and (path.exists() or path.is_symlink()):
        raise UsageError(f"{str(path)!r} exists; name another file with -o, or remove it.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"{str(path)!r} cannot be written: {error}.") from error


def toml_value(value: Any) -> str:
    """Text of a value: a table or list on one line."""
    import tomlkit

    if isinstance(value, Mapping):
        pairs = [f"{tomlkit.key(key).as_string()} = {toml_value(x)}" for key, x in value.items()]
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    return str(tomlkit.item(value).as_string())
