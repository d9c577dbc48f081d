"""Verb `show`: one thing that has a name."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sysid_bench.commands.request import Request, model, python_function
from sysid_bench.commands.result import Result


class Show(Request["ShowResult"]):
    """Show one robot, payload, plug-in, suite, data set or motor.

    Settings of a robot stand behind it, as 'arm.urdf?tool=upper'.
    """

    name: str = model("NAME", complete="robots suites datasets plants names")
    robots_dir: Path | None = None

    def run(self) -> "ShowResult":
        """Return a robot's manifest as read, a payload, the settings of a plug-in, a suite, a data
        set, a motor or a collection of models; for a kind, the titles of its names.

        Raises UsageError with the nearest name of any kind.
        """
        from sysid_bench.commands.catalogue import find_entry

        return ShowResult(*find_entry(self.name, self.robots_dir))


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
