"""A Python that imports a copy of the package, as another version of it would be installed."""

import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]


def python_with(folder: Path, place: Path) -> Path:
    """The executable of an environment at `place`, with the libraries of this one, that imports the
    package in `folder`, or else this one.

    The hook of an editable installation does not act there."""
    venv.create(place, with_pip=False)
    (site,) = (place / "lib").glob("python*/site-packages")
    known = [entry for entry in sys.path if "packages" in entry or "cmeel" in entry]
    (site / "other.pth").write_text("\n".join([str(folder), *known, str(ROOT)]) + "\n")
    return place / "bin" / "python"
