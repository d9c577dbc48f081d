"""Model files of installed packages: `example-robot-data:FILE` and `robot_descriptions:NAME`."""

import importlib
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from types import ModuleType
from typing import Final

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, UsageError, reason_of
from sysid_bench.input_files import is_file

PACKAGES: Final = ("example-robot-data", "robot_descriptions")
"""Sources of model files besides the user's own, written `package:rest`."""

_LONGEST: Final = 200
"""Letters of a name to which the nearest is sought: twice those of the longest."""


def is_package_file(source: str) -> bool:
    """True for a text that names a file of a package."""
    package, colon, _ = source.partition(":")
    return bool(colon) and package in PACKAGES


def package_file(source: str, label: str) -> tuple[Path, Path | None]:
    """Return the model file of a `package:rest`, and the folder that it may read files from.

    Reading a robot_descriptions module may download the robot. Raises ModelError, with `label`, for
    what is not installed or cannot be downloaded.
    """
    package, _, rest = source.partition(":")
    if package == "robot_descriptions":
        return _robot_description(rest, label)
    return package_folders.robot_data_folder() / rest, None


def unknown_file(name: str) -> UsageError:
    """The error for an unknown file of example-robot-data, with the nearest names."""
    folder = package_folders.robot_data_folder()
    known = [str(file.relative_to(folder)) for file in folder.rglob("*.urdf")]
    near = _nearest(name, known)
    nearest = f" Did you mean {' or '.join(map(repr, near))}?" if near else ""
    return UsageError(
        f"No file of example-robot-data is called {name!r}.{nearest} There are {len(known)} URDFs."
    )


def _nearest(name: str, known: Sequence[str]) -> list[str]:
    if len(name) > _LONGEST:
        return []
    near, stem = get_close_matches(name, known, n=3, cutoff=0.8), Path(name).stem.lower()
    # Else files that contain the name: a shorter name, or one of another folder.
    return near or [file for file in known if stem in file.lower()][:3]


def _robot_description(name: str, label: str) -> tuple[Path, Path | None]:
    wanted = f"{label}: 'robot_descriptions:{name}'"
    module = _description_module(name, wanted)
    file = getattr(module, "URDF_PATH", None) or getattr(module, "MJCF_PATH", None)
    if file is None:
        raise ModelError(f"{wanted} is not a robot: it has neither a URDF nor an MJCF.")
    path, folder = Path(file), getattr(module, "PACKAGE_PATH", None)
    if not is_file(path):
        raise ModelError(f"{wanted}: its file {str(path)!r} does not exist; download it again.")
    return path, Path(folder) if folder and path.is_relative_to(folder) else None


def _description_module(name: str, wanted: str) -> ModuleType:
    """Import a module of robot_descriptions, which downloads its robot."""
    try:
        return importlib.import_module(f"robot_descriptions.{_public_identifier(name)}")
    except ModuleNotFoundError as error:
        raise ModelError(
            f"{wanted} is not installed or not known; "
            "pip install robot_descriptions, and see its list of names."
        ) from error
    except Exception as error:  # its modules clone repositories while they are imported
        raise ModelError(
            f"{wanted} could not be downloaded ({reason_of(error)[:200]}); the internet is needed "
            "once, for the robot's files."
        ) from error


def _public_identifier(name: str) -> str:
    if not name.isidentifier() or name.startswith("_"):
        raise ModuleNotFoundError(name)
    return name
