"""Survey of one model file in a worker process: the product's answer, then the engines' own."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import mujoco

from sysid_bench.commands.crosscheck import crosscheck
from sysid_bench.experiments.job_channel import JobChannel
from sysid_bench.models.model_checks import recorded_warnings
from sysid_bench.types import Row

CALL: Final = f"{__name__}:survey_model"
ENGINES: Final = "engines "
"""Prefix of the id of the row of what the engines read."""
_KEPT: Final = (
    *("reason", "nq", "nv", "bodies", "gap", "closure", "native_gap", "base_parameters"),
    *("near_degenerate", "repairs"),
)


def survey_model(argument: Mapping[str, Any], channel: JobChannel) -> None:
    """Write the row of a model's cross-check, then that of what each engine reads of the file as it
    stands; argument: {id, file, assets: folder that it may read from, more: further fields
    of both rows, `samples` among them}."""
    name, file, more = argument["id"], Path(argument["file"]), argument["more"]
    measures: dict[str, Callable[[], Row]] = {
        name: lambda: _answer(file, more["samples"], Path(argument["assets"])),
        ENGINES + name: lambda: {reader: _degrees_of_freedom(reader, file) for reader in _READERS},
    }
    for cell, measure in measures.items():
        if cell in channel.cells:
            channel.start_cell(cell)
            wall, cpu = time.perf_counter(), time.process_time()
            row = {"status": "ok", **measure()}
            seconds = {
                "seconds": time.perf_counter() - wall,
                "seconds_cpu": time.process_time() - cpu,
            }
            channel.write({"id": cell, **more, **row, **seconds})


def _answer(file: Path, samples: int, assets: Path) -> Row:
    (result,) = crosscheck(f"file:{file}", samples=samples, assets=assets)
    row: Row = {"status": "ok" if result.ok else "failed", **{key: result[key] for key in _KEPT}}
    if result.coupling is not None:
        row["coupling"] = {key: result.coupling[key] for key in ("gap", "closure", "note")}
    return row


def _degrees_of_freedom(engine: str, file: Path) -> int | str:
    """Model that an engine reads of the file, or its error."""
    try:
        # A singular mass matrix at the reference is not an error by itself: recorded, not printed.
        with recorded_warnings():
            return int(_READERS[engine](file).nv)
    except Exception as error:
        return " ".join(str(error).split())[:300] or type(error).__name__


def _in_pinocchio(file: Path) -> Any:
    import pinocchio

    # By content: URDF files are called .xml as well.
    if b"<robot" in file.read_bytes():
        return pinocchio.buildModelFromUrdf(str(file))
    return pinocchio.buildModelFromMJCF(str(file))


_READERS: Final[Mapping[str, Callable[[Path], Any]]] = {
    "mujoco": lambda file: mujoco.MjModel.from_xml_path(str(file)),
    "pinocchio": _in_pinocchio,
}
