"""Is this machine fit: packages, data, tools."""

import shutil
from typing import Any

from sysid_bench import places
from sysid_bench.errors import SysidBenchError


def doctor() -> dict[str, Any]:
    """`ok`, the environment, and a list of checks {name, ok, needed, detail}."""
    from sysid_bench.versions import environment

    checks = [_packages(), _example_robots(), _robots(), _viewer(), _latex(), _kernel(), _steps()]
    return {
        "ok": all(check["ok"] for check in checks if check["needed"]),
        "environment": environment(),
        "checks": checks,
    }


def _check(name: str, ok: bool, detail: str, needed: bool = True) -> dict[str, Any]:
    return {"name": name, "ok": ok, "needed": needed, "detail": detail}


def _packages() -> dict[str, Any]:
    from importlib import import_module

    absent = []
    for package in (
        "numpy",
        "scipy",
        "pandas",
        "mujoco",
        "pinocchio",
        "sympy",
        "rerun",
        "clarabel",
    ):
        try:
            import_module(package)
        except ImportError as error:
            absent.append(f"{package} ({error})")
    return _check(
        "packages", not absent, "all import" if not absent else f"absent: {', '.join(absent)}"
    )


def _example_robots() -> dict[str, Any]:
    try:
        return _check("example-robot-data", True, str(places.example_robot_data()))
    except SysidBenchError as error:
        return _check("example-robot-data", False, str(error))


def _robots() -> dict[str, Any]:
    from sysid_bench.verbs.catalogue import list_

    robots = list_("robots")
    broken = [robot["name"] for robot in robots if robot["title"].startswith("cannot be read")]
    detail = f"{len(robots)} robots" + (f"; cannot be read: {', '.join(broken)}" if broken else "")
    return _check("robots", not broken and bool(robots), detail)


def _viewer() -> dict[str, Any]:
    from sysid_bench.reporting.recording import viewer

    try:
        return _check("rerun viewer", True, str(viewer()), needed=False)
    except SysidBenchError as error:
        return _check("rerun viewer", False, str(error), needed=False)


def _latex() -> dict[str, Any]:
    found = shutil.which("pdflatex")
    detail = found or "absent: tables are written all the same, and compiled by no test here"
    return _check("pdflatex", found is not None, detail, needed=False)


def _kernel() -> dict[str, Any]:
    from sysid_bench.regressors.kernel_c import selected_kernel

    choice = selected_kernel()
    return _check("regressor kernel", choice.library is not None, str(choice), needed=False)


def _steps() -> dict[str, Any]:
    from sysid_bench.simulation.compiled_steps import steps_library

    found = steps_library()
    told = f"Python: {found}" if isinstance(found, str) else "compiled"
    return _check("simulation steps", not isinstance(found, str), told, needed=False)
