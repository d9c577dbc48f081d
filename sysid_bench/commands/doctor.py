"""Verb `doctor`: packages, data and tools of this machine."""

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from sysid_bench import package_folders
from sysid_bench.commands.request import FAILED, OK, Request, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import SysidBenchError
from sysid_bench.extras import EXTRAS

PACKAGES: Final = (
    "numpy", "scipy", "pandas", "mujoco", "clarabel", "matplotlib",
)  # fmt: skip


class Doctor(Request["DoctorResult"]):
    """Check this machine."""

    def run(self) -> "DoctorResult":
        """Check the packages, data and tools of this machine."""
        from sysid_bench.regressors.kernel_c import select_kernel
        from sysid_bench.reporting.view import rerun_tool
        from sysid_bench.simulation.compiled_steps import steps_library
        from sysid_bench.simulation.plant_batch import lanes_library
        from sysid_bench.version_fields import environment

        kernel, steps, latex = select_kernel(), steps_library(), shutil.which("pdflatex")
        no_latex = "absent: LaTeX tables are still written, but no test compiles them here"
        stepping = f"Python: {steps}" if isinstance(steps, str) else "compiled"
        lanes = lanes_library()
        batches = f"MuJoCo: {lanes}" if isinstance(lanes, str) else f"compiled, {lanes[1]}"
        checks = [
            _packages(),
            _second_engine(),
            _found("example-robot-data", package_folders.robot_data_folder, needed=False),
            _robots(),
            _found("rerun viewer", rerun_tool, needed=False),
            _extras(),
            _Check("pdflatex", latex is not None, latex or no_latex, needed=False),
            _Check("regressor kernel", kernel.library is not None, str(kernel), needed=False),
            _Check("simulation steps", not isinstance(steps, str), stepping, needed=False),
            _Check("batched simulation", not isinstance(lanes, str), batches, needed=False),
        ]
        ok = all(check.ok for check in checks if check.needed)
        return DoctorResult(ok, environment(), [asdict(check) for check in checks])

    def exit_code(self, result: "DoctorResult") -> int:
        return OK if result.ok else FAILED


doctor = python_function(Doctor, "doctor")


@dataclass(frozen=True, eq=False, repr=False)
class DoctorResult(Result):
    """`ok`: every needed check passes; `checks`: [{name, ok, needed, detail}]."""

    ok: bool
    environment: dict[str, Any]
    checks: list[dict[str, Any]]

    def summary(self) -> str:
        """One line per check."""
        words = {True: "MISSING", False: "absent (optional)"}
        return "\n".join(
            f"{check['name']:<20} {'ok' if check['ok'] else words[check['needed']]:<18} "
            f"{check['detail']}"
            for check in self.checks
        )


@dataclass(frozen=True)
class _Check:
    name: str
    ok: bool
    detail: str
    needed: bool = True


def _found(name: str, find: Callable[[], Any], needed: bool = True) -> _Check:
    """Check of something that is found, or else refused with a reason."""
    try:
        return _Check(name, True, str(find()), needed)
    except SysidBenchError as error:
        return _Check(name, False, str(error), needed)


def _packages() -> _Check:
    absent = []
    for package in PACKAGES:
        try:
            import_module(package)
        except ImportError as error:
            absent.append(f"{package} ({error})")
    return _Check(
        "packages", not absent, f"absent: {', '.join(absent)}" if absent else "all import"
    )


def _second_engine() -> _Check:
    from sysid_bench.evaluation.second_engine import ENGINES, second_engine

    engine = second_engine()
    return _Check("second engine", engine == "pinocchio", ENGINES[engine], needed=False)


def _extras() -> _Check:
    names = {package.replace("-", "_"): extra for package, extra in EXTRAS.items()}
    absent = sorted({extra for module, extra in names.items() if not _is_there(module)})
    advice = f"absent: {', '.join(absent)} (pip install 'sysid-bench[{','.join(absent)}]')"
    return _Check("extras", not absent, advice if absent else "all", needed=False)


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of a module in a package that is absent
        return False


def _robots() -> _Check:
    from sysid_bench.commands.catalogue import entries_of_kind

    robots = entries_of_kind("robots")
    broken = [robot for robot in robots if robot["title"].startswith("cannot be read")]
    unread = f"; cannot be read: {', '.join(one['name'] for one in broken)}" if broken else ""
    # Descriptions of an optional package are not this installation's fault.
    optional = broken and all("needs example-robot-data" in one["title"] for one in broken)
    ok = bool(robots) and not broken
    return _Check("robots", ok, f"{len(robots)} robots{unread}", needed=not optional)
