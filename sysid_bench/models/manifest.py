"""Manifest of a robot: the contents of `robots/<name>/robot.toml`, or a model file on its own."""

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sysid_bench import package_folders
from sysid_bench.errors import ModelError, UsageError, unknown_name, value_errors
from sysid_bench.input_files import is_file, is_folder, read_toml
from sysid_bench.models.data_sets import SCHEME, find_dataset
from sysid_bench.models.random_robot import random_coupled_robot, random_robot
from sysid_bench.models.sources import (
    PACKAGES,
    is_package_file,
    package_file,
    source_settings,
    unknown_file,
)

TERMS: Final = ("viscous", "coulomb", "offset", "armature", "spring")
"""Joint terms that can be identified besides the inertial parameters."""

DRIVE_TERMS: Final = ("viscous", "coulomb", "offset", "armature")
"""Terms of real joints, where nobody names others. Without the inertia of the rotors links become
too heavy: the upper arm of a UR10e by a factor of ten (measured)."""

TERM_ADVICE: Final = "Terms of single joints are written 'j1.k' or 'j5.fv.j6'."


def is_term(word: str) -> bool:
    """True for a kind of joint term, or a parameter, which is checked against the robot later."""
    return word in TERMS or ("." in word and not word.startswith(".") and " " not in word)


MODEL_SUFFIXES: Final = (".urdf", ".xml", ".mjcf")


def _finite(value: Any) -> Any:
    # Before pydantic's conversion, which takes true for 1 and "1" for 1.
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"must be a number, got {value!r}")
    if not abs(value) <= sys.float_info.max:  # also integers that no float holds
        raise ValueError(f"must be finite, got {str(value)[:20]}")
    return value


def _positive(value: Any) -> Any:
    if _finite(value) <= 0:
        raise ValueError(f"must be positive, got {value!r}")
    return value


def _not_negative(value: Any) -> Any:
    if _finite(value) < 0:
        raise ValueError(f"must not be negative, got {value!r}")
    return value


Finite = Annotated[float, BeforeValidator(_finite)]
NotNegative = Annotated[float, BeforeValidator(_not_negative)]
Positive = Annotated[float, BeforeValidator(_positive)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class Limits(_Table):
    """Limits of a joint: q (rad, m), v (/s), a (/s^2), tau (N m, N); None: taken from the model."""

    q: tuple[Finite, Finite] | None = None  # lowest and highest position
    v: Positive | None = None  # largest rate
    a: Positive | None = None  # largest acceleration
    tau: Positive | None = None  # largest torque or force


class JointTerms(_Table):
    """Joint terms of the simulated robot besides inertia; None: taken from the model."""

    viscous: NotNegative | None = None  # N m s/rad
    coulomb: NotNegative | None = None  # N m
    offset: Finite | None = None  # N m
    armature: NotNegative | None = None  # kg m^2
    spring: Finite | None = None  # N m/rad
    spring_reference: Finite | None = None  # rad
    viscous_coupling: dict[str, Finite] = Field(default_factory=dict)  # N m s/rad, by other joint


class Sensor(_Table):
    """A force/torque sensor that cuts the robot at a fixed joint, site or body."""

    name: str  # name of the sensor
    at: str  # fixed joint, site or body where it cuts


class _CouplingTable(_Table):
    """Independent joints among coupled ones; the remaining choice is automatic."""

    independent: tuple[str, ...] = ()  # joints that are independent


class Source(_Table):
    """Origin of the model; further keys are free."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)
    licence: str = ""  # licence of the model


class Dh(_Table):
    """Denavit-Hartenberg table that the model was generated from (`sysid-bench init robot`)."""

    table: str  # file of the table
    convention: Literal["standard", "modified"] = "standard"  # of the parameters
    frames: Literal["joint", "link"] = "joint"  # what a row's frame is fixed to
    base: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # roll, pitch, yaw, rad


class Paper(_Table):
    """Order of the bodies in a paper's base parameters, and parameters that it sets to zero."""

    order: tuple[str, ...] = ()  # bodies from first to last
    zero: tuple[str, ...] = ()  # parameters that the paper takes as zero


class Lint(_Table):
    """Findings of lint that are meant to be: rules ("axes"), or rules of one element
    ("mass:link3")."""

    ignore: tuple[str, ...] = ()  # rules, or rules of one element


class RobotKeys(_Table):
    """Keys of robot.toml as written."""

    name: str  # name on the command line
    title: str = ""  # one line about the robot
    file: str  # URDF or MJCF beside this file, or in a package
    assets: str | None = None  # folder that an MJCF may read; default: its own
    tool: str | None = None
    """Body or frame that carries payloads; default: the end of the longest chain."""
    free_base: bool = False  # the root body floats
    gravity: tuple[Finite, Finite, Finite] | None = None
    """In the base frame, m/s^2; default: the model's."""
    terms: tuple[str, ...] = ()  # joint terms that are identified by default
    limits: dict[str, Limits] = Field(default_factory=dict)  # by joint name, or `all`
    joints: dict[str, JointTerms] = Field(default_factory=dict)
    """Terms of the simulated robot by joint name, or `all`."""
    locked: dict[str, Finite] = Field(default_factory=dict)
    """Position of joints that do not move, rad or m."""
    massless: tuple[str, ...] = ()  # bodies whose parameters are not unknowns
    dh: Dh | None = None  # table that the model was made from
    paper: Paper | None = None  # order of a paper's base parameters
    couplings: bool = True  # `false`: mimic joints and closed loops are ignored
    coupling: _CouplingTable = _CouplingTable()  # choice of independent joints
    sensor: tuple[Sensor, ...] = ()  # force/torque sensors
    source: Source = Source()  # origin and licence
    lint: Lint = Lint()  # findings that are meant to be


@dataclass(frozen=True)
class Manifest:
    """Description of a robot: `path` is the model file; `limits` and `joints` go by joint name or
    "all"."""

    name: str
    path: Path
    title: str = ""
    assets: Path | None = None  # folder that an MJCF may read files from; None: its own
    tool: str | None = None
    free_base: bool = False
    gravity: tuple[float, float, float] | None = None
    terms: tuple[str, ...] = ()
    limits: Mapping[str, Limits] = field(default_factory=dict)
    joints: Mapping[str, JointTerms] = field(default_factory=dict)
    couplings: bool = True  # False: mimic joints and closed loops are ignored
    independent: tuple[str, ...] = ()  # coupled joints that must be independent
    sensors: tuple[Sensor, ...] = ()
    licence: str = ""
    manifest_file: Path | None = None
    locked: Mapping[str, float] = field(default_factory=dict)  # joints that do not move (rad, m)
    massless: tuple[str, ...] = ()  # bodies whose parameters are not unknowns
    dh: Dh | None = None
    paper: Paper | None = None
    suppressed: tuple[str, ...] = ()  # findings of lint that are meant to be
    text: str | None = None  # the model itself where there is no file; `path` is then a label
    source: str = ""  # what `find_manifest` finds it by, where that is not one of its files
    by_path: bool = field(default=False, compare=False)
    """True for a robot without a name: its seeds come from its model (see `model_record`)."""
    content: str | None = field(default=None, compare=False)
    """Hash of the model from which its seeds come, where that is another one than this."""


RANDOM: Final = "random"
"""Source of random robots: `random:SEED`, `random:KIND:SEED`."""


def find_manifest(
    source: str, robots_dir: Path | None = None, folder: Path | None = None
) -> Manifest:
    """Return the manifest of `source`: a name, a folder with robot.toml, a model file, a file of a
    package ("example-robot-data:ur_description/urdf/ur5_robot.urdf", "robot_descriptions:NAME"), a
    random tree ("random:7"), a random robot with a mechanism ("random:four-bar:7"), or the robot of
    a data set ("dataset:ur10").

    Paths ("file:x.urdf", "x.urdf", "x/robot.toml") are relative to `folder`. Settings may follow,
    "ur5?tool=hand" (see `sources`). Raises UsageError for a name or file that does not
    exist, ModelError for a manifest that cannot be read.
    """
    plain, settings = source_settings(source)
    found = replace(_plain_manifest(plain, robots_dir, folder), **settings)
    # A path can be written in many ways: what it leads to makes the robot.
    if plain.startswith(SCHEME):
        by_path = plain.removeprefix(SCHEME) not in package_folders.dataset_files()
    else:
        is_other = plain.startswith(f"{RANDOM}:") or is_package_file(plain)
        by_path = not is_other and _is_path(plain)
    return replace(found, by_path=by_path)


def _is_path(source: str) -> bool:
    suffixes = (*MODEL_SUFFIXES, ".toml")
    return source.startswith("file:") or "/" in source or Path(source).suffix in suffixes


def _plain_manifest(source: str, robots_dir: Path | None, folder: Path | None) -> Manifest:
    """The manifest of a source without settings."""
    if source.startswith(f"{RANDOM}:"):
        return _random(source)
    if source.startswith(SCHEME):
        found = find_dataset(source.removeprefix(SCHEME), folder)
        robot = found.described.robot
        if isinstance(robot, str):
            return find_manifest(robot, robots_dir, found.file.parent)
        written = _checked_keys({"name": found.described.name, **robot}, found.file)
        if is_package_file(written.file):
            path, assets = _model_path(written.file, found.file)
        else:  # a file of the data, in any of their folders
            path, assets = found.file_of(written.file), None
        manifest = _manifest(written, found.file, path, assets)
        return replace(manifest, source=f"{SCHEME}{found.file.resolve()}")
    if is_package_file(source):
        package, _, rest = source.partition(":")
        path, assets = package_file(source, source)
        if not is_file(path):
            raise unknown_file(rest)
        described = package == "robot_descriptions"
        name = rest.removesuffix("_description") if described else path.stem
        return Manifest(name=name, path=path, title=rest, assets=assets)
    if _is_path(source):
        return _from_path((folder or Path()) / source.removeprefix("file:"), source)
    table = package_folders.robots(robots_dir)
    if source in table:
        return read_manifest(table[source])
    if is_file((folder or Path()) / source):
        kinds = ", ".join(MODEL_SUFFIXES)
        raise UsageError(f"{source!r} is not a model file ({kinds}) and not a robot.toml.")
    named = PurePath(source)
    if named.suffix[1:].isalpha():  # a file: no name of a robot resembles it
        same = f", or the robot {named.stem!r}" if named.stem in table else ""
        raise UsageError(
            f"The file {source!r} does not exist, and its suffix is not of a model file: give a "
            f"URDF or MJCF file ({', '.join(MODEL_SUFFIXES)}){same}."
        )
    raise unknown_name("robot", source, table, "Or give the path of a URDF or MJCF file.")


def read_manifest(file: Path) -> Manifest:
    """Read the manifest in a robot.toml; raises one ModelError that lists all its errors."""
    keys = read_toml(file, ModelError)
    # One sentence in place of one for each key.
    for key, kind in (("schema", "a suite"), ("q", "the description of a recording")):
        if key in keys and not {"name", "file"} <= keys.keys():
            raise UsageError(
                f"{file} is {kind} (it has the key {key}), not a robot: give a robot's name, a "
                "URDF or MJCF file, or a robot.toml, which has the keys name and file."
            )
    written = _checked_keys(keys, file)
    return _manifest(written, file, *_model_path(written.file, file))


def _manifest(written: RobotKeys, file: Path, path: Path, assets: Path | None) -> Manifest:
    """Return the manifest with keys of `file` and the model at `path`."""
    for term in written.terms:
        if not is_term(term):
            raise ModelError(f"{file}: {unknown_name('joint term', term, TERMS, TERM_ADVICE)}")
    ranges = {name: limits.q for name, limits in written.limits.items() if limits.q is not None}
    for name, (low, high) in ranges.items():
        if not low < high:
            raise ModelError(f"{file}: limits.{name}.q must be [low, high]; got {[low, high]}.")
    same = (
        *("name", "tool", "free_base", "gravity", "terms", "limits", "joints", "couplings"),
        *("locked", "massless", "dh", "paper"),
    )
    fields: dict[str, Any] = {key: getattr(written, key) for key in same}
    return Manifest(
        path=path,
        assets=assets if written.assets is None else path.parent / written.assets,
        title=written.title or written.name,
        independent=written.coupling.independent,
        sensors=written.sensor,
        licence=written.source.licence,
        suppressed=written.lint.ignore,
        manifest_file=file,
        **fields,
    )


def _checked_keys(keys: Mapping[str, Any], file: Path) -> RobotKeys:
    """Return the keys of a robot.toml once they fit; raises one ModelError with all mistakes."""
    try:
        return RobotKeys.model_validate(keys)
    except ValidationError as error:
        lines, values = [], []
        for problem in error.errors():
            if problem["type"] != "extra_forbidden":
                values.append(problem)
                continue
            *place, key = map(str, problem["loc"])
            table = _TABLES.get(place[0], Source) if place else RobotKeys
            unknown = unknown_name("key", key, sorted(table.model_fields))
            lines.append(f"{'.'.join((*place, key))}: {unknown}".rstrip("."))
        lines += [f"{key}: {text}" for key, text in value_errors(values).items()]
        raise ModelError(f"{file}: {'; '.join(lines)}.") from error


_TABLES: Final[Mapping[str, type[BaseModel]]] = {
    "limits": Limits,
    "joints": JointTerms,
    "coupling": _CouplingTable,
    "sensor": Sensor,
}


def _from_path(path: Path, source: str) -> Manifest:
    if is_folder(path):
        file = path / "robot.toml"
        if not is_file(file):
            raise UsageError(
                f"{str(path)!r} is a folder without robot.toml; give the model file in it."
            )
        return read_manifest(file)
    if not is_file(path):
        known = ", ".join(package_folders.robots())
        written = "" if source == str(path) else f" ({source!r})"
        raise UsageError(
            f"The model file {str(path)!r}{written} does not exist; named robots: {known}."
        )
    if path.suffix == ".toml":
        return read_manifest(path)
    return Manifest(name=path.stem, path=path, title=path.stem)


def is_model(source: str) -> bool:
    """True for a text that names a model without a list of robots: file, package or random."""
    scheme, colon, _ = source.partition(":")
    return bool(colon) and scheme in (RANDOM, "file", SCHEME.removesuffix(":"), *PACKAGES)


def _random(source: str) -> Manifest:
    kind, _, seed = source.removeprefix(f"{RANDOM}:").rpartition(":")
    if not re.fullmatch("[0-9]{1,18}", seed):
        raise UsageError(
            f"{source!r}: the seed of a random robot must be a whole number of at most 18 digits; "
            "write 'random:7' for a tree, 'random:four-bar:7' for one with a mechanism."
        )
    text = random_coupled_robot(kind, int(seed)) if kind else random_robot(int(seed))
    title = f"A random {kind or 'tree'}, seed {int(seed)}"
    return Manifest(source, Path(source), title=title, text=text)


def _model_path(written: str, manifest: Path) -> tuple[Path, Path | None]:
    """The model file of a manifest, and the folder of the package that it may read files from."""
    if is_package_file(written):
        try:
            path, assets = package_file(written, str(manifest))
        except UsageError:  # without the package: a copy beside the manifest, which lacks meshes
            path, assets = manifest.parent / Path(written).name, None
            if not is_file(path):
                raise
    else:
        path, assets = manifest.parent / written, None
    if not is_file(path):
        raise ModelError(
            f"{manifest}: the model file {written!r} does not exist (looked at {path})."
        )
    return path, assets
