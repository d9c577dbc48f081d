"""A new robot folder from a Denavit-Hartenberg table."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sysid_bench.errors import UsageError


def init_robot(
    table: str | Path,
    out: str | Path | None = None,
    name: str | None = None,
    modified: bool = False,
    frames: str = "joint",
    base: Sequence[float] = (0.0, 0.0, 0.0),
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    massless: Sequence[str] = (),
) -> dict[str, Any]:
    """Writes robot.toml, the MJCF and a copy of the table to the folder `out` (default: named after
    the table); returns {robot, folder, files, joints, following, warnings}.

    Masses that the table leaves out are made up: bars of water from joint to joint. Raises
    UsageError for a table that cannot be read or a folder that holds a robot already, ModelError
    for a robot that cannot be.
    """
    from sysid_bench.models.dh.dh_robot import mjcf_of
    from sysid_bench.models.dh.dh_table import read_table
    from sysid_bench.models.load import load_robot

    source = Path(table)
    read = read_table(source)
    called = name or source.stem
    convention = "modified" if modified else "standard"
    if frames not in ("joint", "link"):
        raise UsageError(f"frames must be 'joint' or 'link'; got {frames!r}.")
    text = mjcf_of(read, called, convention, frames, base, gravity, massless)  # type: ignore[arg-type]
    folder = Path(out) if out is not None else Path(called)
    if (folder / "robot.toml").exists():
        raise UsageError(f"{str(folder)!r} holds a robot already; name another folder with -o.")
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / f"{called}.xml"
    model.write_text(text, encoding="utf-8")
    if source.resolve() != (folder / "dh.csv").resolve():
        shutil.copyfile(source, folder / "dh.csv")
    manifest = folder / "robot.toml"
    manifest.write_text(
        _manifest(called, convention, frames, base, massless, [row.link for row in read.rows
                                                               if row.kind != "F"]),
        encoding="utf-8",
    )  # fmt: skip
    robot = load_robot(manifest)
    made_up = [f"link{row.link}" for row in read.rows if row.kind != "F" and row.mass is None]
    invented = [body for body in made_up if body.removeprefix("link") not in massless]
    return {
        "robot": called,
        "folder": str(folder),
        "files": [str(file) for file in (manifest, model, folder / "dh.csv")],
        "joints": list(robot.torque_rows),
        "following": [row for row in robot.rows if row not in robot.torque_rows],
        "warnings": [f"masses made up: {', '.join(invented)}"] if invented else [],
    }


def parse_numbers(text: str, what: str) -> tuple[float, float, float]:
    """Three numbers of "0 pi/2 0"; raises UsageError."""
    from sysid_bench.models.dh.dh_expression import read_expression

    words = text.replace(",", " ").split()
    if len(words) != 3:
        raise UsageError(f"{what}: write three numbers, as '0 pi/2 0'; got {text!r}.")
    x, y, z = (read_expression(word, {}, frozenset(), what).constant for word in words)
    return x, y, z


def _manifest(
    name: str,
    convention: str,
    frames: str,
    base: Sequence[float],
    massless: Sequence[str],
    links: Sequence[str],
) -> str:
    bodies = ", ".join(f'"link{link}"' for link in links)
    light = ", ".join(f'"link{link}"' for link in massless)
    numbers = ", ".join(f"{x:.17g}" for x in base)
    return (
        f'name  = "{name}"\nfile  = "{name}.xml"\nterms = ["viscous", "coulomb"]\n'
        + (f"massless = [{light}]  # not asked for\n" if light else "")
        + f'[dh]\ntable      = "dh.csv"\nconvention = "{convention}"\nframes     = "{frames}"\n'
        + (f"base       = [{numbers}]\n" if any(base) else "")
        + f"[paper]\norder = [{bodies}]\n[limits.all]\nv = {2.0}\na = {5.0}\n"
    )


def summary(answer: dict[str, Any]) -> list[str]:
    """What was written."""
    follows = f"; {', '.join(answer['following'])} follow" if answer["following"] else ""
    return [
        f"{answer['robot']} in {answer['folder']}: joints {', '.join(answer['joints'])}{follows}",
        *(f"  warning: {warning}" for warning in answer["warnings"]),
        f"  next: sysid-bench crosscheck {answer['folder']}/robot.toml",
    ]
