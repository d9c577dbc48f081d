"""Position and velocity columns in another order than the joints, or the joints themselves."""

from collections.abc import Iterator
from itertools import combinations
from typing import Final

import numpy as np

from sysid_bench.diagnosis.edit import columns_edit, joints_edit
from sysid_bench.diagnosis.hypothesis import Candidate, Hypothesis

BLIND: Final = "joints that move alike, or that carry almost no torque"


def joint_columns(before: Hypothesis) -> Iterator[Candidate]:
    """Yield candidates that exchange two columns of q and v, or two joints with their torques."""
    e = before.evidence
    for i, j in combinations(range(e.count), 2):
        order = list(range(e.count))
        order[i], order[j] = j, i
        pair = f"{e.joints[i]} and {e.joints[j]}"
        exchanged = before.with_motion(before.motion.columns(order))
        yield Candidate(
            name="columns", joints=(i, j), hypothesis=exchanged, blind=BLIND,
            message=f"the positions of {pair} are exchanged",
            edit=columns_edit(e, ["q", "v"], order),
        )  # fmt: skip
        yield Candidate(
            name="columns", joints=(i, j), blind=BLIND,
            hypothesis=exchanged.with_torque(np.eye(e.count)[:, order]),
            message=f"the joints {pair} are exchanged: positions and torques",
            edit=joints_edit(e, order),
        )  # fmt: skip
