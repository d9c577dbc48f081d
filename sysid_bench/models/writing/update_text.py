"""Editing of a model file in place, with the round-trip check that both formats share."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

from sysid_bench.errors import ModelError
from sysid_bench.models.writing.update import Bodies, Joints, Update, update_of
from sysid_bench.models.writing.written_check import check_written
from sysid_bench.models.writing.xml_text import Edit, Element, edit_text, element_tree
from sysid_bench.models.xml_file import read_file

FORMATS: Final = {"mujoco": "an MJCF", "robot": "a URDF"}
Edits = Callable[[bytes, Element, Update], Iterable[Edit]]


def update_text(
    path: Path | str,
    bodies: Bodies,
    joints: Joints | None,
    verdicts: Mapping[str, str] | None,
    tag: str,
    edits: Edits,
) -> str:
    """Return the text of a file whose root is <tag>, changed by `edits(data, root, update)` and
    checked by reading it again.

    Raises ModelError for values that must not be written, and for a file of another format.
    """
    path = Path(path)
    update = update_of(path, bodies, joints or {}, verdicts)
    data = read_file(path)
    root = element_tree(data, path.name)
    if root.tag != tag:
        raise ModelError(
            f"{path.name} is not {FORMATS[tag]}: its root element is <{root.tag}>, not <{tag}>."
        )
    text = edit_text(data, edits(data, root, update))
    check_written(path, text, update)
    return text
