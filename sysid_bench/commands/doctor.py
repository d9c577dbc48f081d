"""Verb `doctor`: packages, data and tools of this machine."""

import shutil
from dataclasses import asdict, dataclass
from importlib import import_module
from typing import Any, Final

from sysid_bench import package_folders
from sysid_bench.commands.request import FAILED, OK, Request, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import SysidBenchError

PACKAGES: Final = (
    "numpy", "scipy", "pandas", "mujoco", "pinocchio", "sympy", "rerun", "clarabel",
)  # fmt: skip


class Doctor(Request["DoctorResult"]):
    """Check this machine."""

    def run(self) -> "DoctorResult":
        """Check the packages, data and tools of this machine."""
        from sysid_bench.version_fields import environment

        checks = [_packages(), _example_robots(), _robots(), _viewer(), _latex(), *_compiled()]
        return DoctorResult(
            ok=all(check.ok for check in checks if check.needed),
            environment=environment(),
            checks=[asdict(check) for check in checks],
        )

    def exit_code(self, result: "DoctorResult") -> int:
        return OK if result.ok else FAILED


doctor = python_function(Doctor, "doctor")


@dataclass(frozen=True)
class _Check:
    name: str
    ok: bool
    detail: str
    needed: bool = True


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


def _packages() -> _Check:
    absent = [reason for package in PACKAGES if (reason := _import_failure(package))]
    detail = f"absent: {', '.join(absent)}" if absent else "all import"
    return _Check("packages", not absent, detail)


def _import_failure(package: str) -> str:
    """Name and error of a package that does not import; "" for one that does."""
    try:
        import_module(package)
    except ImportError as error:
        return f"{package} ({error})"
    return ""


def _example_robots() -> _Check:
    try:
        return _Check("example-robot-data", True, str(package_folders.robot_data_folder()))
    except SysidBenchError as error:
        return _Check("example-robot-data", False, str(error))


def _robots() -> _Check:
    from sysid_bench.commands.catalogue import entries_of_kind

    robots = entries_of_kind("robots")
    broken = [robot["name"] for robot in robots if robot["title"].startswith("cannot be read")]
    detail = f"{len(robots)} robots"
    if broken:
        detail += f"; cannot be read: {', '.join(broken)}"
    return _Check("robots", bool(robots) and not broken, detail)


def _viewer() -> _Check:
    from sysid_bench.reporting.view import rerun_tool

    try:
        return _Check("rerun viewer", True, str(rerun_tool()), needed=False)
    except SysidBenchError as error:
        return _Check("rerun viewer", False, str(error), needed=False)


def _latex() -> _Check:
    found = shutil.which("pdflatex")
    detail = found or "absent: LaTeX tables are still written, but no test compiles them here"
    return _Check("pdflatex", found is not None, detail, needed=False)


def _compiled() -> list[_Check]:
    """Code in C: regressors, and steps of the simulation."""
    from sysid_bench.regressors.kernel_c import select_kernel
    from sysid_bench.simulation.compiled_steps import steps_library

    kernel, steps = select_kernel(), steps_library()
    detail = f"Python: {steps}" if isinstance(steps, str) else "compiled"
    return [
        _Check("regressor kernel", kernel.library is not None, str(kernel), needed=False),
        _Check("simulation steps", not isinstance(steps, str), detail, needed=False),
    ]
