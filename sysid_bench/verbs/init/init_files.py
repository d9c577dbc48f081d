"""First suite and first estimator of one's own: init suite, init estimator."""

import keyword
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sysid_bench.commands.result import Result
from sysid_bench.errors import UsageError
from sysid_bench.input_files import is_file
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import find_manifest
from sysid_bench.models.sources import source_settings, with_settings
from sysid_bench.verbs.init.init_log import toml_value
from sysid_bench.verbs.init.new_file import relative_to, write_new

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


@dataclass(frozen=True, eq=False, repr=False)
class InitFileResult(Result):
    """Written file, and the command to run next."""

    file: str
    next: str

    def summary(self) -> str:
        """File, and the command to run next."""
        return f"{self.file} written\n  next: {self.next}"


def init_suite(
    robot: str | Path = "ur5", out: str | Path = "suite.toml", *, force: bool = False
) -> InitFileResult:
    """Write a first suite for a robot: its name, or a model file.

    Raises UsageError for an unknown robot and for an existing file without `force`.
    """
    target = Path(out)
    load_robot(find_manifest(str(robot)))
    plain, settings = source_settings(str(robot))
    path = Path(plain)
    use = f"file:{relative_to(path, target.parent)}" if is_file(path) else plain
    use = with_settings(use, settings)
    text = _SUITE.format(name=toml_value(target.stem), robot=toml_value(use))
    write_new(target, text, force)
    return InitFileResult(file=str(target), next=f"sysid-bench plan {target}")


def init_estimator(
    name: str = "Mine", out: str | Path | None = None, *, force: bool = False
) -> InitFileResult:
    """Write a first estimator: a class `name` in the file `out` (default: name.py).

    Raises UsageError for a name that no class can have, and for an existing file without `force`.
    """
    if not name.isidentifier() or keyword.iskeyword(name):
        raise UsageError(f"An estimator is a class: {name!r} cannot be its name; write 'Mine'.")
    target = Path(f"{name.lower()}.py" if out is None else out)
    write_new(target, _ESTIMATOR.format(name=name, file=target.name), force)
    command = f"sysid-bench check-plugin --kind estimator file:{target}:{name}"
    return InitFileResult(file=str(target), next=command)
