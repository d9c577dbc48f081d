"""A kind of input that is read, and makers of its files."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from sysid_bench.errors import UsageError
from sysid_bench.models.load import load_robot
from sysid_bench.models.manifest import read_manifest
from sysid_bench.models.payload import PAYLOADS
from tests.faults import fuzz_seeds as seeds


@dataclass(frozen=True)
class Kind:
    """Files made in a folder, the patterns of those that are damaged, and their reader.

    `places`: other things than files may stand in their place.
    """

    name: str
    make: Callable[[Path], object]
    damaged: tuple[str, ...]
    read: Callable[[Path], object]
    places: bool = True


def text_files(files: Mapping[str, str]) -> Callable[[Path], None]:
    """Maker of text files."""

    def make(folder: Path) -> None:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)

    return make


def every(steps: Iterable[Callable[[], object]]) -> None:
    """Take all steps, also behind one that refuses; raise the last refusal."""
    refused = None
    for step in steps:
        try:
            step()
        except UsageError as error:
            refused = error
    if refused is not None:
        raise refused


def make_log(folder: Path) -> None:
    """Make a log description of scara and its numbers."""
    text_files({"log.toml": seeds.LOG})(folder)
    rng = np.random.default_rng(0)
    t = np.arange(120) / 100
    waves = np.sin(2 * np.pi * np.outer(t, [1, 2, 3, 4]) + np.arange(4)) * [1, 20, 0.05, 1]
    columns = np.column_stack([t, waves, rng.normal(size=(120, 4))])
    np.savetxt(folder / "log.csv", columns, delimiter=",", header="t,a,b,c,d,e,f,g,h", fmt="%.5g")


_LOADERS: Final = (
    "sysid_bench.experiments.recorded.prepare",
    "sysid_bench.experiments.recorded.process_log",
    "sysid_bench.models.load",
)
"""Modules that load the robots of recordings and of published tables."""


@contextmanager
def sound_robots() -> Iterator[None]:
    """Robots of the package, which nobody damages, are loaded once a process: they take most of the
    time of reading a recording."""
    with ExitStack() as stack:
        for module in _LOADERS:
            stack.enter_context(patch(f"{module}.load_robot", _load_once))
        others = "sysid_bench.diagnosis.model_candidates"
        stack.enter_context(patch(f"{others}.read_manifest", cache(read_manifest)))
        stack.enter_context(patch(f"{others}.load_robot", _load_once))
        yield


_loaded: Final[dict[Any, Any]] = {}


def _load_once(source: Any, *settings: Any, **named: Any) -> Any:
    if settings and settings[0] is not PAYLOADS["none"]:
        return load_robot(source, *settings, **named)
    key = str(source), str(named)
    if key not in _loaded:
        _loaded[key] = load_robot(source, *settings, **named)
    return _loaded[key]
