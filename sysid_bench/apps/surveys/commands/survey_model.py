"""Survey of one model file in a worker process: the product's answer, then the engines' own."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import pinocchio

from sysid_bench.commands.crosscheck import CrosscheckResult, crosscheck
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
        ENGINES + name: lambda: _engines(file),
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
    row = {key: result[key] for key in _KEPT}
    return {"status": "ok" if result.ok else "failed", **row, **_coupling(result)}


def _coupling(result: CrosscheckResult) -> Row:
    if result.coupling is None:
        return {}
    kept = ("gap", "closure", "note")
    return {"coupling": {key: result.coupling[key] for key in kept}}


def _engines(file: Path) -> Row:
    """Degrees of freedom that each engine reads, or its error."""
    return {"mujoco": _of_engine(_in_mujoco, file), "pinocchio": _of_engine(_in_pinocchio, file)}


def _of_engine(read: Callable[[Path], int], file: Path) -> int | str:
    try:
        return read(file)
    except Exception as error:
        return " ".join(str(error).split())[:300] or type(error).__name__


def _in_mujoco(file: Path) -> int:
    with recorded_warnings():
        return int(mujoco.MjModel.from_xml_path(str(file)).nv)


def _in_pinocchio(file: Path) -> int:
    build = pinocchio.buildModelFromUrdf if _is_urdf(file) else pinocchio.buildModelFromMJCF
    return int(build(str(file)).nv)


def _is_urdf(file: Path) -> bool:
    return b"<robot" in file.read_bytes()
