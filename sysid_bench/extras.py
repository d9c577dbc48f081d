"""Packages of extras: imported when something needs them, and named where they are missing."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from sysid_bench.errors import UsageError

EXTRAS: Final = {
    "example-robot-data": "robots",
    "rerun": "rerun",
    "pyarrow": "parquet",
    "rosbags": "logs",
    "h5py": "logs",
    "protobuf": "logs",
    "distributed": "cluster",
    "dask_jobqueue": "cluster",
    "cryptography": "cluster",
    "cma": "peers",
    "mujoco.sysid": "peers",
    "robot_descriptions": "descriptions",
}
"""Extra by the package, or module, that it installs."""


def missing(package: str, what: str, otherwise: str = "") -> UsageError:
    """Return the error where `what` needs a package of an extra; `otherwise`: what needs none."""
    extra = f"pip install 'sysid-bench[{EXTRAS[package]}]'"
    more = f" {otherwise}" if otherwise else ""
    return UsageError(f"{what} needs {package}, which is not installed: {extra}.{more}")


def extra_module(module: str, what: str, otherwise: str = "") -> Any:
    """Return a module of an extra; raises UsageError with the command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module if module in EXTRAS else module.partition(".")[0]
        package = {"google": "protobuf"}.get(package, package)
        if package != module and find_spec(package) is not None:
            # The floor of rerun-sdk is below the version that reads: pip would not upgrade it.
            name = "rerun-sdk" if package == "rerun" else f"'sysid-bench[{EXTRAS[package]}]'"
            raise UsageError(
                f"{what} needs {module}, which the installed {package} lacks: "
                f"pip install --upgrade {name}."
            ) from error
        raise missing(package, what, otherwise) from error
