"""The built-in estimators as somebody else's: the same code, found in a file; a talkative one."""

import numpy as np

from sysid_bench.plugin_names import BUILTIN, resolve
from sysid_bench.types import Estimate, Problem

for _name in BUILTIN["estimator"]:
    globals()[_name.replace("-", "_")] = resolve("estimator", _name)


class Talkative:
    def __init__(self, size: int) -> None:
        self.size = size

    def solve(self, problem: Problem) -> Estimate:
        beta = np.linalg.lstsq(problem.W, problem.b, rcond=None)[0]
        return Estimate(beta, stats={f"{n:099d}": 0.0 for n in range(self.size // 108)})


class Turned(Talkative):
    """Says of itself that it depends on the frames of the links."""

    def __init__(self, declared: object) -> None:
        self.size, self.frame_dependent = 0, declared
