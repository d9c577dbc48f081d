"""The conda recipe and the citation say what pyproject.toml says."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = (ROOT / ".conda" / "recipe.yaml").read_text(encoding="utf-8")
NAMES = {"mujoco": "mujoco-python", "pin": "pinocchio", "matplotlib": "matplotlib-base"}
"""Names of conda-forge that are not those of wheels."""


def listed(section: str) -> list[str]:
    """Entries of a list of requirements."""
    (found,) = re.findall(rf"^  {section}:\n((?:    - .*\n)+)", RECIPE, re.MULTILINE)
    return [line.removeprefix("    - ").strip() for line in found.splitlines()]


def value(key: str) -> str:
    """The text of a key that stands once."""
    (found,) = re.findall(rf"^ *{key}: (.+)$", RECIPE, re.MULTILINE)
    return str(found).strip().strip('"')


def test_the_recipe_requires_what_the_wheel_requires() -> None:
    wanted = [f"python {PROJECT['requires-python']}"]
    for written in PROJECT["dependencies"]:
        plain = written.partition(";")[0]  # Pinocchio has packages of conda for all platforms
        name, limits = re.fullmatch(r"([a-z0-9-]+?)([<>=!].*)", plain).groups()  # type: ignore[union-attr]
        wanted.append(f"{NAMES.get(name, name)} {limits}")
    assert listed("run") == wanted
    assert listed("host")[0] == wanted[0]


def test_the_recipe_is_of_this_version_and_licence() -> None:
    assert re.findall(r'^  version: "(.+)"$', RECIPE, re.MULTILINE) == [PROJECT["version"]]
    assert value("name") == PROJECT["name"]
    assert value("summary") == PROJECT["description"]
    assert value("license") == PROJECT["license"]
    assert value("license_file") in PROJECT["license-files"]


def test_the_recipe_builds_as_the_wheel_is_built() -> None:
    (backend,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert backend.replace(">=", " >=") in listed("host")
    assert {"cmake >=3.15", '${{ compiler("c") }}'} <= set(listed("build"))


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {PROJECT['version']}\n" in citation
    assert f"\nlicense: {PROJECT['license']}\n" in citation
