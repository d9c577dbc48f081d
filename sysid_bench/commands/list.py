"""Verb `list`: the names of a kind."""

from pathlib import Path
from typing import Any

from sysid_bench.commands.request import (
    OK,
    Request,
    argument,
    python_function,
    robots_option,
)


class List(Request[list[dict[str, Any]]]):
    """List the names of a KIND.

    One of robots, payloads, tasks, terms, plants, excitations, simulations, pipelines, filters,
    estimators, metrics, suites, datasets, model-errors, sensor-errors, log-readers, executors,
    integrators, statistics, intervals, statuses, collections, motors.
    """

    kind: str = argument("KIND", complete="kinds")
    robots_dir: Path | None = robots_option()

    def run(self) -> list[dict[str, Any]]:
        """Return everything of a kind (robots, payloads, tasks, excitations, estimators, suites,
        simulations, plants, model-errors, sensor-errors, pipelines, metrics, log-readers, datasets,
        collections, motors, terms, filters, integrators, executors, statistics, intervals,
        statuses; singular or plural) with name and title; the title of an entry that cannot be read
        states the reason."""
        from sysid_bench.commands.catalogue import entries_of_kind

        return entries_of_kind(self.kind, self.robots_dir)

    def shell(self, as_json: bool) -> int:
        from sysid_bench.commands.terminal import print_entries, print_json

        if as_json:
            print_json(self.run())
        else:
            print_entries(self.run(), f"sysid-bench list {self.kind} | less")
        return OK


list_ = python_function(List, "list_")
