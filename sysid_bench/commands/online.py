"""Verb `online`: payload and joint friction from a stream of samples."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from sysid_bench.commands.request import NOTHING, OK, Request, argument, model, python_function
from sysid_bench.commands.result import Result
from sysid_bench.errors import UnsupportedError

if TYPE_CHECKING:
    from sysid_bench.experiments.online_fit import OnlineFit


class Online(Request["OnlineResult"]):
    """Follow a stream of samples, and print the payload at the tool and the friction of the joints
    with their standard deviations, once a second of the stream.

    The robot's own bodies are those of MODEL. STREAM is a file that may grow, - for standard input,
    or tcp://HOST:PORT, with a line per sample: {"t": s, "q": [...], "tau": [...]}, or CSV below a
    header with t, JOINT.q and JOINT.tau.
    """

    has_json: ClassVar[bool] = False
    source: str | Path = model("MODEL")
    stream: str = argument("STREAM", complete="files")
    robots_dir: Path | None = None
    report: "Callable[[OnlineResult], None] | None" = None

    def run(self) -> "OnlineResult":
        """Return the estimate at the end of a stream; `report` gets each of those before.

        Raises UsageError for a line that is not a sample, UnsupportedError for a robot with joints
        of several degrees of freedom or coupled ones.
        """
        from sysid_bench.experiments.online_fit import OnlineFit, windows
        from sysid_bench.models.load import load_robot
        from sysid_bench.models.payload import Payload
        from sysid_bench.signals.stream import stream_samples

        unknown = Payload("unknown", 1.0, inertia=(1e-3,) * 3 + (0.0,) * 3)
        robot = load_robot(self.source, unknown, robots_dir=self.robots_dir)
        if robot.coupling is not None or len(robot.scalar_dofs) != robot.nv:
            raise UnsupportedError(f"{robot.name}: only arms of uncoupled hinges and slides.")
        fit, t, reported = OnlineFit(robot), 0.0, -1.0
        for motion, tau, moving in windows(stream_samples(self.stream, robot.rows)):
            fit.add(motion, tau, moving)
            t = float(motion.t[0])
            if self.report is not None and not reported <= t < reported + 1.0:
                reported = t
                self.report(_result(fit, t))
        return _result(fit, t)

    def shell(self, as_json: bool) -> int:
        """Print each estimate: a line on a terminal, a JSON object into a file or pipe."""

        def show(result: OnlineResult) -> None:
            print(
                json.dumps(result.to_dict()) if not sys.stdout.isatty() else result.summary(),
                flush=True,
            )

        result = replace(self, report=show).run()
        show(result)
        return OK if result.samples else NOTHING


def _result(fit: "OnlineFit", t: float) -> "OnlineResult":
    found = fit.estimate()
    terms = [{"fv": fv, "fc": fc, "offset": c} for fv, fc, c in found.joints.tolist()]
    return OnlineResult(
        t=t,
        samples=found.samples,
        mass=float(found.mass),
        mass_std=float(found.mass_std),
        com=tuple(found.com.tolist()),
        com_std=tuple(found.com_std.tolist()),
        joints=dict(zip(fit.rows, terms, strict=True)),
    )


online = python_function(Online, "online")


@dataclass(frozen=True, eq=False, repr=False)
class OnlineResult(Result):
    """Estimate after `t` (s) of a stream from `samples` windows: mass (kg) and centre (m, in the
    tool frame) of the payload, and {joint: {fv, fc, offset}}, each with its standard deviation."""

    t: float
    samples: int
    mass: float
    mass_std: float
    com: tuple[float, ...]
    com_std: tuple[float, ...]
    joints: dict[str, dict[str, tuple[float, float]]]

    def summary(self) -> str:
        """One line."""
        if not self.samples:
            return "The stream holds no tenth of a second of samples: nothing is estimated."
        centre = "  ".join(
            f"{x:.4f} ± {s:.2g}" for x, s in zip(self.com, self.com_std, strict=True)
        )
        friction = "; ".join(
            f"{name} " + ", ".join(f"{term} {x:.3g} ± {s:.1g}" for term, (x, s) in terms.items())
            for name, terms in self.joints.items()
        )
        return (
            f"{self.t:9.2f} s  mass {self.mass:.4f} ± {self.mass_std:.2g} kg  centre {centre} m  "
            f"| {friction}"
        )
