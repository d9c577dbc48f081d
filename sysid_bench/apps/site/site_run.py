"""A run, or a submission, as a site shows it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from sysid_bench.canonical_json import canonical_hash
from sysid_bench.metrics import METRICS
from sysid_bench.reporting.selection import Choose
from sysid_bench.types import Metric

if TYPE_CHECKING:
    import pandas as pd

_OF_ENTRANTS: Final = (
    "title", "estimator", "table", "ranking", "claim", "paper", "macro", "record", "origin",
    "metric",
)  # fmt: skip
"""Keys of a suite in which runs of one version may differ: who takes part, and what is shown."""
_OF_MACHINES: Final = ("timeout", "memory", "threads")


@dataclass(frozen=True)
class Submission:
    """Content of submission.toml: `name` of the entry, its `authors`, a `url` and `notes`; any may
    be empty."""

    name: str = ""
    authors: str = ""
    url: str = ""
    notes: str = ""


@dataclass(frozen=True)
class RepeatShare:
    """Cells of a submission that were run again and gave the same values: `cells` of the `drawable`
    ones, drawn with `seed`."""

    seed: int
    drawable: int
    cells: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SiteRun:
    """Rows of a run. `methods`: the estimator behind each label, as JSON; `rankings`: its entries;
    `sealed`: labels of plants whose sizes are secret; `notes` on rows of other code."""

    name: str
    suite: Mapping[str, Any]
    env: Mapping[str, Any]
    cells: "pd.DataFrame"
    planned: int
    choose: Choose
    methods: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=lambda: METRICS)
    sealed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    submission: Submission | None = None
    checked: RepeatShare | None = None

    @property
    def version(self) -> str:
        """8 hex digits of what is measured: the suite without its methods and tables. Runs with the
        same name and version may be compared."""
        kept = {key: value for key, value in self.suite.items() if key not in _OF_ENTRANTS}
        limits = kept.get("run") or {}
        kept["run"] = {key: value for key, value in limits.items() if key not in _OF_MACHINES}
        return canonical_hash(kept)[:8]

    @property
    def code_version(self) -> str:
        """Commit of the package that made the rows; "" where it is unknown."""
        git = self.env.get("git") or {}
        changed = " with changes" if git.get("dirty") else ""
        return f"{str(git['commit'])[:12]}{changed}" if git.get("commit") else ""

    @property
    def package(self) -> str:
        """Version of the package that made the rows."""
        return str((self.env.get("versions") or {}).get("sysid-bench") or "unknown")
