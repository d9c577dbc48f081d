"""Names of bodies and joints that the model file leaves unnamed."""

from collections.abc import Collection

import mujoco

from sysid_bench.models.tree import FREE


def name_elements(spec: mujoco.MjSpec) -> None:
    """Name unnamed bodies and joints of a compiled spec by their index: `body3`, `joint2`; the only
    free joint is `root`.

    The index is that in the tree without payload, so that mounting a payload renames nothing.
    """
    free = [joint for joint in spec.joints if int(joint.type) == FREE]
    taken = {element.name for element in [*spec.bodies, *spec.joints]}
    for body in spec.bodies:
        if not body.name:
            body.name = free_name(f"body{body.id}", taken)
    for joint in spec.joints:
        if not joint.name:
            only = len(free) == 1 and int(joint.type) == FREE
            joint.name = free_name("root" if only else f"joint{joint.id + 1}", taken)


def free_name(name: str, taken: Collection[str]) -> str:
    """The name with as many underscores behind it as make it differ from those taken."""
    while name in taken:
        name += "_"
    return name
