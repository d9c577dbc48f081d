"""Verbs `list` and `show`: the names of a kind, and one thing that has a name."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.commands.request import (
    OK,
    Request,
    argument,
    model,
    python_function,
    robots_option,
)
from sysid_bench.commands.result import Result


class List(Request[list[dict[str, Any]]]):
    """List the names of a KIND; without one, the kinds.

    One of robots, payloads, tasks, terms, plants, excitations, simulations, pipelines, filters,
    estimators, metrics, suites, datasets, model-errors, sensor-errors, log-readers, executors,
    integrators, statistics, intervals, statuses, collections, motors.
    """

    kind: str | None = argument("KIND", default=None, complete="kinds")
    robots_dir: Path | None = robots_option()

    def run(self) -> list[dict[str, Any]]:
        """Return everything of a kind (robots, payloads, tasks, excitations, estimators, suites,
        simulations, plants, model-errors, sensor-errors, pipelines, metrics, log-readers, datasets,
        collections, motors, terms, filters, integrators, executors, statistics, intervals,
        statuses; singular or plural) with name and title; the title of an entry that cannot be read
        states the reason. Without a kind, the kinds."""
        from sysid_bench.commands.catalogue import entries_of_kind

        return entries_of_kind(self.kind, self.robots_dir)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_entries, print_json

        if as_json:
            print_json(self.run())
        else:
            # First: a title that is too long for its lines loses its end.
            marked = [
                entry | {"title": f"(not ranked) {entry['title']}"}
                if entry.get("frame_dependent") else entry
                for entry in self.run()
            ]  # fmt: skip
            print_entries(marked, f"sysid-bench list {self.kind or 'KIND'} | less")
        return OK


class Show(Request["ShowResult"]):
    """Show one robot, payload, plug-in, suite, data set or motor.

    Settings of a robot stand behind it, as 'arm.urdf?tool=upper'.
    """

    name: str = model("NAME", complete="robots suites datasets plants names")
    robots_dir: Path | None = None

    def run(self) -> "ShowResult":
        """Return a robot's manifest as read, a payload, the settings of a plug-in, a suite, a data
        set, a motor or a collection of models; for a kind, the titles of its names. `robots_dir`:
        folder of robots of one's own.

        Raises UsageError with the nearest name of any kind.
        """
        from sysid_bench.commands.catalogue import find_entry

        return ShowResult(*find_entry(self.name, self.robots_dir))


list_ = python_function(List, "list_")
show = python_function(Show, "show")


@dataclass(frozen=True, eq=False, repr=False)
class ShowResult(Result):
    """Entry of the catalogue; its keys depend on its kind."""

    kind: str
    entry: dict[str, Any]

    def summary(self) -> str:
        """One line per key."""
        values = self._fields()
        width = max(map(len, values))
        return "\n".join(
            f"{key:<{width}}  {v if isinstance(v, str) else json.dumps(v, default=str)}"
            for key, v in values.items()
        )

    def _fields(self) -> dict[str, Any]:
        return {"kind": self.kind, **self.entry}
