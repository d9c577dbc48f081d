"""Registry of plug-ins: "ols", "package.module:Class", "file:mine.py:Class", entry points.

Built-in names map to strings, so that looking a name up imports nothing; `tests/test_naming.py`
compares the table with the folders. Plug-in authors add names with an entry point in the group
`sysid_bench.<kind>s`, or use "module:object" without registration.
"""

import dataclasses
import hashlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Final, get_args, get_origin

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.input_files import check_file, is_file
from sysid_bench.units import quantity

BUILTIN: Final[Mapping[str, Mapping[str, str]]] = MappingProxyType(
    {
        "estimator": {
            "a-priori": "sysid_bench.identification.estimators.bayesian:APriori",
            "ar-gls": "sysid_bench.identification.estimators.robust:ArGls",
            "bounded": "sysid_bench.identification.estimators.feasible:Bounded",
            "clie": "sysid_bench.identification.estimators.closed_loop:CLIE",
            "cloe": "sysid_bench.identification.estimators.closed_loop:CLOE",
            "cma-es": "sysid_bench.apps.peers.estimators:FitCmaEs",
            "didim": "sysid_bench.identification.estimators.didim_iv:DIDIM",
            "didim-guarded": "sysid_bench.identification.estimators.closed_loop:GuardedDIDIM",
            "ekf": "sysid_bench.identification.estimators.filters:EKF",
            "entropic": "sysid_bench.identification.estimators.feasible:Entropic",
            "essential": "sysid_bench.identification.estimators.linear:Essential",
            "file-friction": "sysid_bench.identification.estimators.bayesian:FileFriction",
            "huber": "sysid_bench.identification.estimators.robust:Huber",
            "irls": "sysid_bench.identification.estimators.robust:IRLS",
            "iv": "sysid_bench.identification.estimators.didim_iv:IV",
            "kalman": "sysid_bench.identification.estimators.recursive:Kalman",
            "lmi": "sysid_bench.identification.estimators.feasible:LMI",
            "lmi-euclidean": "sysid_bench.identification.estimators.feasible:LMIEuclidean",
            "lmi-pullback": "sysid_bench.identification.estimators.feasible:LMIPullback",
            "log-cholesky": "sysid_bench.identification.estimators.feasible:LogCholesky",
            "min-norm": "sysid_bench.identification.estimators.linear:MinNorm",
            "ml": "sysid_bench.identification.estimators.ml:ML",
            "mujoco-sysid": "sysid_bench.apps.peers.estimators:FitMujocoSysid",
            "ols": "sysid_bench.identification.estimators.linear:OLS",
            "payload-difference": "sysid_bench.identification.estimators.linear:Difference",
            "prior": "sysid_bench.identification.estimators.bayesian:PriorMean",
            "reconstruction": "sysid_bench.identification.estimators.feasible:Reconstruction",
            "ridge": "sysid_bench.identification.estimators.bayesian:Ridge",
            "rls": "sysid_bench.identification.estimators.recursive:RLS",
            "rollout": "sysid_bench.identification.estimators.rollout:Rollout",
            "scipy-least-squares": "sysid_bench.apps.peers.estimators:FitScipy",
            "tls": "sysid_bench.identification.estimators.linear:TLS",
            "tukey": "sysid_bench.identification.estimators.robust:Tukey",
            "ukf": "sysid_bench.identification.estimators.filters:UKF",
            "wls": "sysid_bench.identification.estimators.linear:WLS",
            "wls-guarded": "sysid_bench.identification.estimators.bayesian:GuardedWLS",
        },
        "excitation": {
            "b-spline": "sysid_bench.excitation.random_motions:BSplines",
            "chirp": "sysid_bench.excitation.random_motions:Chirp",
            "file": "sysid_bench.excitation.motion_file:MotionFile",
            "fourier": "sysid_bench.excitation.random_motions:Fourier",
            "fourier-other": "sysid_bench.excitation.random_motions:HeldOutFourier",
            "fourier-polynomial": "sysid_bench.excitation.random_motions:FourierPolynomial",
            "multisine": "sysid_bench.excitation.random_motions:Multisine",
            "optimised": "sysid_bench.excitation.optimised:Optimised",
            "ptp": "sysid_bench.excitation.random_motions:PointToPoint",
            "random-waypoints": "sysid_bench.excitation.random_motions:RandomWaypoints",
            "static": "sysid_bench.excitation.random_motions:Static",
            "wander": "sysid_bench.excitation.random_motions:RandomWaypoints",
        },
        "task": {
            "actuators": "sysid_bench.apps.actuators.task:ActuatorsTask",
            "robot": "sysid_bench.experiments.tasks.definitions:RobotTask",
            "payload": "sysid_bench.experiments.tasks.definitions:PayloadTask",
            "link": "sysid_bench.experiments.tasks.definitions:LinkTask",
            "terminal": "sysid_bench.experiments.tasks.definitions:TerminalTask",
            "wrench": "sysid_bench.experiments.tasks.definitions:WrenchTask",
            "wrench-payload": "sysid_bench.experiments.tasks.definitions:WrenchPayloadTask",
        },
        "simulation": {
            "inverse": "sysid_bench.simulation.inverse:Inverse",
            "closed-loop": "sysid_bench.simulation.tracking_control:TrackingControl",
        },
        "log_reader": {
            "delimited-text": "sysid_bench.signals.log_readers.tables:DelimitedText",
            "hdf5": "sysid_bench.signals.log_readers.arrays:HDF5",
            "lerobot": "sysid_bench.signals.log_readers.tables:Lerobot",
            "matlab": "sysid_bench.signals.log_readers.arrays:Matlab",
            "numpy": "sysid_bench.signals.log_readers.arrays:NumpyArrays",
            "parquet": "sysid_bench.signals.log_readers.tables:Parquet",
            "rerun": "sysid_bench.signals.log_readers.messages:RerunRecording",
            "rosbag1": "sysid_bench.signals.log_readers.messages:Rosbag1",
            "rosbag2": "sysid_bench.signals.log_readers.messages:Rosbag2",
        },
        "executor": {
            "dask": "sysid_bench.apps.clusters.dask:Dask",
            "local": "sysid_bench.harness.executor:Local",
            "slurm": "sysid_bench.apps.clusters.slurm:Slurm",
        },
        "term": {
            "play": "sysid_bench.regressors.joint_features:Play",
            "playq": "sysid_bench.regressors.joint_features:PositionPlay",
            "poly": "sysid_bench.regressors.joint_features:Polynomial",
            "tanh": "sysid_bench.regressors.joint_features:SmoothFriction",
        },
        "pipeline": {
            "parallel": "sysid_bench.signals.pipelines:Parallel",
            "plain": "sysid_bench.signals.pipelines:Plain",
            "raw": "sysid_bench.signals.pipelines:Raw",
        },
        "metric": {},  # sysid_bench/metrics.py has the built-in ones
        "plant": {
            "matched": "sysid_bench.simulation.plant:Matched",
            "asymmetric-friction": "sysid_bench.simulation.effects.friction:Asymmetric",
            "cables": "sysid_bench.simulation.effects.springs:Cables",
            "curved-friction": "sysid_bench.simulation.effects.friction:CurvedFriction",
            "elastic-joints": "sysid_bench.simulation.effects.springs:ElasticJoints",
            "gravity-spring": "sysid_bench.simulation.effects.springs:GravitySpring",
            "load-friction": "sysid_bench.simulation.effects.friction:LoadFriction",
            "low-harmonics": "sysid_bench.simulation.effects.periodic:LowHarmonics",
            "lugre": "sysid_bench.simulation.effects.presliding:Lugre",
            "periodic-friction": "sysid_bench.simulation.effects.periodic:Periodic",
            "play": "sysid_bench.simulation.effects.presliding:Play",
            "stribeck": "sysid_bench.simulation.effects.presliding:Stribeck",
            "torque-ripple": "sysid_bench.simulation.effects.periodic:TorqueRipple",
            "warm-up": "sysid_bench.simulation.effects.friction:WarmUp",
        },
        "model_error": {
            "base-tilt": "sysid_bench.simulation.model_errors:BaseTilt",
            "coupling": "sysid_bench.simulation.model_errors:CouplingError",
            "gear-ratio": "sysid_bench.simulation.model_errors:GearRatio",
            "kinematics": "sysid_bench.simulation.model_errors:Kinematics",
            "payload-mount": "sysid_bench.simulation.model_errors:PayloadMount",
        },
        "sensor_error": {
            "current-ripple": "sysid_bench.simulation.sensor_errors:CurrentRipple",
            "delay": "sysid_bench.simulation.sensor_errors:Delay",
            "eccentricity": "sysid_bench.simulation.sensor_errors:Eccentricity",
            "jitter": "sysid_bench.simulation.sensor_errors:Jitter",
            "lost-samples": "sysid_bench.simulation.sensor_errors:LostSamples",
            "torque-drift": "sysid_bench.simulation.sensor_errors:TorqueDrift",
            "torque-gain": "sysid_bench.simulation.sensor_errors:TorqueGain",
            "torque-noise": "sysid_bench.simulation.sensor_errors:TorqueNoise",
        },
    }
)


def known(kind: str) -> dict[str, str]:
    """Return every name of a kind with its target "module:object", built in or an entry point.

    A kind of two words is written "log_reader" or "log-reader". An entry point does not replace a
    built-in name, whose rows would then be of other code in every suite.
    """
    key = kind.replace("-", "_")
    built_in = BUILTIN.get(key, {})
    points = {point.name: _target(point) for point in _points(key) if point.name not in built_in}
    return {**built_in, **points}


RESERVED: Final[Mapping[str, tuple[str, ...]]] = {"plant": ("simulation", "noise", "pipeline")}
"""Keys of an entry of a suite that are not settings of its plug-in."""


def is_of_package(kind: str, name: str) -> bool:
    """Return True for a name of this package: its code is not third-party."""
    return name in BUILTIN.get(kind, {}) or name.startswith("sysid_bench.")


def is_third_party(kind: str, name: str) -> bool:
    """Return True for a name whose code is not of this package; an unknown name has no code."""
    key = kind.replace("-", "_")
    return not is_of_package(key, name) and ":" in known(key).get(name, name)


def source_file(kind: str, name: str) -> Path | None:
    """Return the file of a plug-in without importing it or its package; None where there is none.

    Compiled modules are files, too.
    """
    path = known(kind).get(name, name).rpartition(":")[0]
    if path.startswith("file:"):
        file = Path(path.removeprefix("file:"))
        return file if is_file(file) else None
    root, *parts = path.split(".")
    try:
        spec = importlib.util.find_spec(root) if root else None
    except (ImportError, ValueError):
        return None
    for depth in range(2, len(parts) + 2):
        if spec is None or spec.submodule_search_locations is None:
            return None
        name_so_far = ".".join([root, *parts][:depth])
        # Not importlib's find_spec, which imports the packages around a module.
        spec = PathFinder.find_spec(name_so_far, spec.submodule_search_locations)
    return Path(spec.origin) if spec is not None and spec.origin else None


def resolve(kind: str, name: str) -> Any:
    """Return the object of a name; raises UsageError with the nearest names."""
    table = known(kind)
    target = table.get(name, name)
    if ":" not in target and name in table:
        raise UsageError(
            f"The entry point {name!r} (sysid_bench.{kind.replace('-', '_')}s) names {target!r}; "
            "it has to be 'module:object'."
        )
    if ":" not in target:
        advice = "One of your own is named 'module:object' or 'file:path.py:object'."
        raise unknown_name(_shown(kind), name, table, advice)
    path, _, attribute = target.rpartition(":")
    module = _module(path)
    if not hasattr(module, attribute):
        raise UsageError(f"{path!r} has no {attribute!r} ({_shown(kind)} {name!r}).")
    return getattr(module, attribute)


def _shown(kind: str) -> str:
    """Kind as messages print it."""
    return kind.replace("_", "-")


def build(kind: str, spec: str | Mapping[str, Any]) -> Any:
    """Call the object of a name with its settings: {use = "fourier", period = "5 s"}.

    Settings of a dataclass field with `metadata={"unit": ...}` are read with their unit. Raises
    UsageError for unknown or missing settings.
    """
    if isinstance(spec, str):
        spec = {"use": spec}
    shown = _shown(kind)
    if "use" not in spec:
        raise UsageError(f"A {shown} needs a name: {{ use = ... }}; got the keys {sorted(spec)}.")
    make = resolve(kind, spec["use"])
    for key in RESERVED.get(kind, ()):
        if key in plugin_fields(make):
            raise UsageError(
                f"{shown} {spec['use']!r}: its setting {key!r} is a key of plants, which gives "
                f"them a {key} of their own; call the setting otherwise."
            )
    settings = {key: value for key, value in spec.items() if key not in ("use", "label")}
    if callable(make):
        return make(**plugin_settings(f"{shown} {spec['use']!r}", make, settings))
    if settings:
        raise UsageError(f"{shown} {spec['use']!r} takes no settings; got {sorted(settings)}.")
    return make


def resolve_files(spec: Mapping[str, Any], folder: Path | None) -> dict[str, Any]:
    """Return a plug-in's spec with the paths of "file:mine.py:Class" and of the setting `file`
    relative to the suite's folder."""
    resolved = dict(spec)
    if folder is None:
        return resolved
    use, file = str(spec.get("use")), spec.get("file")
    if use.startswith("file:"):
        path, colon, attribute = use.removeprefix("file:").rpartition(":")
        resolved["use"] = f"file:{folder / path}{colon}{attribute}"
    if isinstance(file, str):
        resolved["file"] = str(folder / file)
    return resolved


def _target(point: EntryPoint) -> str:
    return point.value.partition("[")[0].strip()  # without the extras that it may need


def _points(kind: str) -> tuple[EntryPoint, ...]:
    return tuple(_installed(entry_points).select(group=f"sysid_bench.{kind}s"))


@cache
def _installed(find: Callable[[], EntryPoints]) -> EntryPoints:
    # Reads the metadata of every installed package, some 10 ms; fingerprints need it per cell.
    return find()


def _module(path: str) -> ModuleType:
    if path.startswith("file:"):
        file = Path(path.removeprefix("file:"))
        if not is_file(file):
            raise UsageError(f"The plug-in file {str(file)!r} does not exist.")
        try:
            check_file(file)
        except OSError as error:
            raise UsageError(f"{str(file)!r} is not a file with a plug-in: {error}.") from error
        # By the whole path: two plug-in files of one name are two modules.
        name = f"sysid_bench_file_{hashlib.sha256(bytes(file.resolve())).hexdigest()[:12]}"
        status = file.stat()
        # Time and size are part of the cache's key: an edited plug-in is read again in one session.
        return _executed(name, file, (status.st_mtime_ns, status.st_size))
    if not all(path.split(".")):
        raise UsageError(f"No module is called {path!r}; name one as 'package.module:object'.")
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError as error:
        # The plug-in's own import may fail: blaming its name would hide the mistake.
        if not f"{path}.".startswith(f"{error.name}."):
            raise
        raise UsageError(f"No module is called {path!r} on the path of this Python.") from error


@lru_cache
def _executed(name: str, path: Path, state: tuple[int, int]) -> ModuleType:
    """Import a file in this state; a changed file is read again."""
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{str(path)!r} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up to read postponed annotations, and pickle does too.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def module_files() -> list[tuple[str, str]]:
    """Return (name, file) of the modules in this process."""
    found = ((name, getattr(one, "__file__", None)) for name, one in list(sys.modules.items()))
    return [(name, file) for name, file in found if isinstance(file, str)]


# --- Settings -----------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _SettingField:
    """Field of a plug-in: its unit (None: not read with a unit), and True where its type allows a
    list with one value per joint."""

    unit: str | None
    is_per_joint: bool

    def si_value(self, value: Any) -> Any:
        """Return a value as the plug-in takes it: quantities in SI units."""
        if self.unit is None:
            return value
        if self.is_per_joint and isinstance(value, (list, tuple)):
            return tuple(quantity(one, self.unit) for one in value)
        return quantity(value, self.unit)


def plugin_settings(plugin: str, make: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the plug-in `make` in SI units; `plugin` names it in errors.

    Raises UsageError for unknown, missing or wrong ones.
    """
    try:
        parameters = inspect.signature(make).parameters
    except (TypeError, ValueError):  # written in C, without a signature
        return dict(given)
    kinds = {parameter.kind for parameter in parameters.values()}
    for key in given:
        if key not in parameters and inspect.Parameter.VAR_KEYWORD not in kinds:
            raise unknown_name(f"setting of the {plugin}", key, parameters)
    missing = [key for key, one in parameters.items() if _is_required(one) and key not in given]
    if missing:
        raise UsageError(f"{plugin} needs the settings {', '.join(missing)}.")
    fields, settings = plugin_fields(make), dict(given)
    for key in filter(fields.__contains__, given):
        try:
            settings[key] = fields[key].si_value(given[key])
        except UsageError as error:
            raise UsageError(f"{plugin}, {key}: {error}") from error
    return settings


def _is_required(parameter: inspect.Parameter) -> bool:
    variadic = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return parameter.default is inspect.Parameter.empty and parameter.kind not in variadic


def plugin_fields(make: Any) -> dict[str, _SettingField]:
    """Return the dataclass fields of a plug-in by name; {} for another callable."""
    fields = dataclasses.fields(make) if dataclasses.is_dataclass(make) else ()
    return {f.name: _SettingField(f.metadata.get("unit"), _takes_list(f.type)) for f in fields}


def _takes_list(annotation: Any) -> bool:
    # `from __future__ import annotations` leaves a text, and evaluating it would need its module.
    if isinstance(annotation, str):  # postponed
        return "Sequence[" in annotation or "tuple[" in annotation or "Size" in annotation
    kinds = map(get_origin, (annotation, *get_args(annotation)))
    return any(isinstance(kind, type) and issubclass(kind, Sequence) for kind in kinds)
