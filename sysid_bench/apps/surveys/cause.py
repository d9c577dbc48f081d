"""Causes of refusals, from the sentences of refused models: for counts, never in their place."""

import re
from collections.abc import Mapping
from typing import Any, Final

DISAGREE: Final = "the engines disagree"
RAW: Final = "exception without a sentence"
OTHER: Final = "other"
NO_MASS: Final = "no mass: not a model of dynamics"
_STATUS: Final[Mapping[str, str]] = {
    "timeout": "no answer within the time limit",
    "memory": "no answer within the memory limit",
    "crash": "crash of an engine",
    "lost": "killed from outside",
}
_SENTENCES: Final = (
    (RAW, r"^\w+(Error|Exception|Warning): "),
    ("no moving joint", r"no moving joint"),
    (NO_MASS, r"not a model of dynamics"),
    ("an included file is absent", r"the file of <\w+ file=.* does not exist"),
    ("inertia from meshes that are absent", r"meshes that do not exist|the mesh .* is not defined"),
    ("a file outside the source", r"lies outside the model's folder"),
    ("equalities hold all joints", r"equalities fix all joints"),
    ("larger than the product takes", r"their product may be|elements; simplify|with \d+ degrees"),
    ("unexpanded xacro", r"which xacro has not expanded"),
    ("numbers that are none", r"write three finite numbers|must be a finite number"),
    ("links or joints that do not fit together", r"not one of its links|has no link|root link"),
    ("no well-formed XML", r"not well-formed XML|DOCTYPE"),
    ("a part of a model", r"part to be included"),
    ("MuJoCo cannot read it", r"^MuJoCo cannot read"),
    ("MuJoCo cannot compile it", r"^MuJoCo cannot compile"),
)


def cause_of(row: Mapping[str, Any]) -> str:
    """Return the cause of a refusal, "" for a model that is ok."""
    if row["status"] == "ok":
        return ""
    if row["status"] in _STATUS:
        return _STATUS[row["status"]]
    if row.get("nv") is not None:
        return DISAGREE if "on the tree" not in row["reason"] else "closed chain not reproduced"
    found = (cause for cause, pattern in _SENTENCES if re.search(pattern, row["reason"]))
    return next(found, OTHER)
