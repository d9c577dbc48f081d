"""The pipeline that an experiment names, with the settings that its table `signals` gives."""

from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from sysid_bench.plugin_names import build, resolve, resolve_files

if TYPE_CHECKING:
    from sysid_bench.signals.row_processing import Pipeline  # loads MuJoCo, which plans do without

KIND: Final = "pipeline"
PLAIN: Final = "plain"
"""The pipeline of a specification without one: the table `signals` alone."""

DEFAULT: Final = "parallel"
"""The pipeline of suites, logs and `identify` where none is written; specifications state it."""

OF_SIGNALS: Final = ("filter", "derivatives", "torque")
"""Keys of the table `signals` that are settings of a pipeline; the others are applied elsewhere."""


def pipeline_of(
    written: Mapping[str, Any] | None, signals: Mapping[str, Any], folder: Path | None = None
) -> "Pipeline":
    """Return the pipeline {use, settings}, None: `plain`. Settings that it has in common with the
    table `signals`, and that are not its own, are taken from there.

    Raises UsageError for unknown names and settings.
    """
    spec = resolve_files(written or {"use": PLAIN}, folder)
    make = resolve(KIND, spec["use"])
    taken = signature(make).parameters if callable(make) else {}
    shared = {key: signals[key] for key in OF_SIGNALS if key in signals and key in taken}
    return cast("Pipeline", build(KIND, {**shared, **spec}))


def pipeline_spec(written: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the pipeline {use, settings} of a specification; None for `plain` without settings,
    since ids are older than pipelines."""
    return None if written == {"use": PLAIN} else dict(written)


def default_pipeline(signals: Mapping[str, Any], exact: bool) -> dict[str, Any] | None:
    """Return the pipeline {use} where none is named, for `signals` as written.

    Settings of `plain` choose it. So do exact positions, of motions that are played back and read
    without errors: v and a are then exact, and there is nothing to filter. Anything else, simulated
    or recorded, is `parallel`.
    """
    is_plain = exact or any(key in signals for key in OF_SIGNALS)
    return pipeline_spec({"use": PLAIN if is_plain else DEFAULT})


def default_log_pipeline(signals: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the pipeline {use} of logs that name none: `plain` with a written filter, which is its
    own; rates "from v" suit every pipeline."""
    return default_pipeline({k: x for k, x in signals.items() if k == "filter"}, exact=False)


def signals_of_pipeline(
    signals: Mapping[str, Any], pipeline: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return a table `signals` without the keys that a pipeline other than `plain` ignores."""
    if is_plain(pipeline):
        return dict(signals)
    return {key: value for key, value in signals.items() if key not in OF_SIGNALS}


def is_plain(written: Mapping[str, Any] | None) -> bool:
    """Return True for the pipeline whose settings are the table `signals`."""
    return written is None or written["use"] == PLAIN
