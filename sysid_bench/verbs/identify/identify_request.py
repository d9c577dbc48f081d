"""Request of an identification: what simulated and recorded data have in common."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError
from sysid_bench.signals.pipeline_choice import pipeline_spec


@dataclass(frozen=True, kw_only=True)
class IdentifyRequest:
    """Identification of one robot.

    `model`: a robot's name, a URDF or an MJCF file; `terms`: joint terms that are also unknown
    (None: those of the task); `estimator`: a plug-in (None: the usual one for the data).
    `pipeline`: signal pipeline of the fit, a name or {use, settings} (None: `default_pipeline`).
    `complete`: distance ("entropic", "euclidean", "pullback") in which whole, feasible bodies lie
    nearest to the prior. `model_out`: the model file again, with the identified values; `json_out`:
    the result as a file.
    """

    model: str
    task: str = "robot"
    terms: tuple[str, ...] | None = None
    estimator: str | None = None
    pipeline: str | Mapping[str, Any] | None = None
    complete: str | None = None
    model_out: Path | None = None
    json_out: Path | None = None
    robots_dir: Path | None = None

    def pipeline_with_default(self, default: dict[str, Any] | None) -> dict[str, Any] | None:
        """The pipeline as an experiment names it; the default one where none is given."""
        if self.pipeline is None:
            return default
        written = self.pipeline
        return pipeline_spec({"use": written} if isinstance(written, str) else written)


def check_seed(seed: int) -> None:
    """Raise UsageError for a seed that is not an integer of 0 or more."""
    try:
        valid = seed.__index__() >= 0
    except (AttributeError, TypeError):
        valid = False
    if not valid:
        raise UsageError(f"seed must be an integer of 0 or more, such as 0; got {seed!r}.")
