"""Names of bodies and joints that the model file leaves unnamed."""

from collections.abc import Collection

import mujoco

from sysid_bench.models.tree import FREE


def add_names(spec: mujoco.MjSpec) -> None:
    """Name unnamed bodies and joints of a compiled spec by their index: `body3`, `joint2`; the only
    free joint is `root`.

    The index is that in the tree without payload, so that mounting a payload renames nothing.
    """
    only_free = _only_free_joint(spec)
    taken = {element.name for element in [*spec.bodies, *spec.joints]}
    for body in spec.bodies:
        body.name = body.name or free_name(f"body{body.id}", taken)
    for joint in spec.joints:
        default = "root" if joint.id == only_free else f"joint{joint.id + 1}"
        joint.name = joint.name or free_name(default, taken)


def _only_free_joint(spec: mujoco.MjSpec) -> int | None:
    """Index of the only free joint; None where there are none or several."""
    free = [joint.id for joint in spec.joints if int(joint.type) == FREE]
    return free[0] if len(free) == 1 else None


def free_name(name: str, taken: Collection[str]) -> str:
    """The name with as many underscores behind it as make it differ from those taken."""
    while name in taken:
        name += "_"
    return name
