"""The [[log]] tables of data sets: `dataset = "ur10e"`, or a list, in place of robot and logs."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import PlainValidator, ValidationInfo

from sysid_bench import package_folders, plugin_names
from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.simulated.composed_plant import COMPOSED, KIND_OF
from sysid_bench.experiments.spec import SEALED
from sysid_bench.harness.suite.checks import check_input, list_of, list_values, value_of
from sysid_bench.input_files import parse_toml, read_text
from sysid_bench.models.data_sets import SCHEME, DataSet, find_dataset, find_motion
from sysid_bench.signals.log_description import log_description
from sysid_bench.units import quantity

DATASET: Final = "dataset"
NAME: Final = "training motions"
"""Label of the rows of data sets, whose robot is that of the set."""

_WRITTEN: Final = ("robot", "train", "test")
"""Keys that a data set gives."""


def _share(value: Any) -> float:
    """Return a part of a recording, 0.1 of "10 %" and of 0.1."""
    number = value_of(lambda: quantity(value, "1"))
    if not 0 < number <= 1:
        raise ValueError(f"must be above 0 and at most 1 or 100 %; got {value!r}.")
    return number


Share = Annotated[float, PlainValidator(_share)]


def check_log(written: str | Mapping[str, Any], folder: Path) -> None:
    """Raise UsageError for a log that is not described; a data set need not be here."""
    use = written if isinstance(written, str) else str(written.get("use", ""))
    if use.startswith(SCHEME):
        find_motion(use, folder)
    else:
        log_description(written, folder)


def with_dataset(suite: Mapping[str, Any], sources: Sequence[Any]) -> dict[str, Any]:
    """Return a suite with these data sets, names or folders from the current one, in the place of
    those that its [[log]] tables name; of a payload task the sets with a known payload alone.

    Raises UsageError for an unknown set, and for a suite without a table of data sets.
    """
    # Names of sets stay; a place of one's own is found from the current folder now.
    found = [find_dataset(str(source)) for source in sources]
    named = zip(map(str, sources), found, strict=True)
    places = [s if one.has_name else f"file:{one.file.resolve()}" for s, one in named]
    tables = list_values(suite.get("log", ()))
    if not any(isinstance(one, Mapping) and DATASET in one for one in tables):
        raise UsageError(
            f"--set {DATASET}: no [[log]] of this suite names a data set; write one with "
            f'{DATASET} = "{sources[0] if sources else "NAME"}".'
        )
    return {**suite, "log": [one for table in tables for one in _with_places(table, places)]}


def _with_places(written: Any, places: Sequence[str]) -> Iterator[Any]:
    """Yield a table with these sets, or nothing where none of them serves its task."""
    if not isinstance(written, Mapping) or DATASET not in written:
        yield written
        return
    loaded = written.get("task") == "payload"
    serve = [one for one in places if not loaded or find_dataset(one).described.payload]
    if serve:
        yield {**written, DATASET: serve}


def dataset_tables(value: Any, info: ValidationInfo) -> Any:
    """Return the [[log]] tables with one of its own for each data set that a table names."""
    if not isinstance(value, (list, tuple)):
        return value
    entries: list[Any] = []
    for written in value:
        if not isinstance(written, Mapping) or DATASET not in written:
            entries.append(written)
            continue
        for source in list_of(written[DATASET]):
            entries += value_of(partial(list, _of_set(written, str(source), info)))
    return tuple(entries)


def _of_set(
    written: Mapping[str, Any], source: str, info: ValidationInfo
) -> Iterator[dict[str, Any]]:
    """Yield the table of a data set; of a payload task one for each known payload."""
    if both := [key for key in _WRITTEN if key in written]:
        raise UsageError(
            f"a data set gives {' and '.join(both)}; name the motions of one as a log, "
            f'train = ["{SCHEME}{source}/MOTION"], or drop the keys.'
        )
    described = find_dataset(source, check_input(info).folder).described
    place = f"{SCHEME}{source}"
    keys = {key: value for key, value in written.items() if key != DATASET}
    accept = list(dict.fromkeys([*list_values(keys.get("accept", ())), *described.accept]))
    common = {"name": NAME, **keys, "robot": place, "accept": accept}
    common |= _suitable(described, keys)
    if keys.get("task") != "payload":
        train = [f"{place}/{motion}" for motion in described.train]
        # The label of a test says how it is related to the training.
        test = [
            {"use": f"{place}/{motion}", "name": f"{motion} ({described.split})"}
            for motion in described.test
        ]
        yield {**common, "train": train, "test": test}
        return
    if not described.payload:
        raise UsageError(f"the data set {source!r} has no recording with a known payload.")
    for pair in described.payload:
        motions = [f"{place}/{pair.empty}", f"{place}/{pair.loaded}"]
        yield {**common, "train": motions, "true_mass": pair.mass}


def _suitable(described: DataSet, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that the recording needs: its own of the named pipelines, and terms to choose."""
    found: dict[str, Any] = {}
    own = described.pipeline
    if own is not None and "pipeline" in keys:
        names = (own["use"], {"use": own["use"]})
        found["pipeline"] = [own if one in names else one for one in list_of(keys["pipeline"])]
    if described.choose:
        found["choose"] = _with_terms(keys.get("choose", []), described.choose)
    return found


def _with_terms(written: Any, terms: Sequence[str]) -> Any:
    """The sweep of lists of terms, each with `terms` besides."""
    if not isinstance(written, (list, tuple)):
        return written  # not a list: refused as it is
    lists = list(written)
    sweep = lists if lists and all(isinstance(one, (list, tuple)) for one in lists) else [lists]
    return [list(dict.fromkeys([*one, *terms])) for one in sweep]


SCHEMA: Final = 1
"""Version of the format of plant files."""

SIGNALS: Final = plugin_names.RESERVED["plant"]
"""Keys of a plant that hold in place of those of the suite."""

_KEYS: Final = ("schema", "name", "title", SEALED, *KIND_OF, *SIGNALS)
_OWN: Final = (*KIND_OF, *SIGNALS, "label")
"""Keys that a suite may write beside the name of a plant file."""
_PREFIX: Final = "file:"


def with_plant_file(written: Any, folder: Path | None) -> Any:
    """Return the plant of a suite with the keys of the file that it names; keys beside `use`
    replace those of the file. Anything else is returned as it is.

    Relative paths are found from `folder`. Raises UsageError for a file that cannot be read, for
    unknown keys, and for a name of neither a plant file nor an effect.
    """
    if not isinstance(written, Mapping) or not isinstance(written.get("use"), str):
        return written
    use, files = written["use"], package_folders.plant_files()
    if use.startswith(_PREFIX) and use.endswith(".toml"):
        data = read_plant((folder or Path()) / use.removeprefix(_PREFIX))
    elif use in files:
        data = read_plant(files[use])
    else:
        # "module:object" and "file:path.py:object" are looked up elsewhere.
        names = (*files, COMPOSED, *plugin_names.known("plant"))
        if ":" not in use and use not in names:
            raise unknown_name("plant", use, names)
        return written
    own = {key: value for key, value in written.items() if key != "use"}
    for key in own:
        if key not in _OWN:
            raise unknown_name("key of a plant file", key, _OWN)
    table = {key: value for key, value in data.items() if key not in ("schema", "title")}
    return {**table, **own, "use": COMPOSED}


def read_plant(file: Path) -> dict[str, Any]:
    """Return the keys of a plant file, its name among them.

    Raises UsageError where it cannot be read, for another schema and for unknown keys.
    """
    try:
        data = parse_toml(read_text(file))
    except (OSError, ValueError) as error:
        raise UsageError(f"The plant file {str(file)!r} cannot be read: {error}.") from error
    for key in data:
        if key not in _KEYS:
            raise UsageError(f"{file}: {unknown_name('key of a plant file', key, _KEYS)}")
    if data.get("schema") != SCHEMA:
        raise UsageError(f"{file}: schema = {data.get('schema')!r}; this version reads {SCHEMA}.")
    return {"name": file.stem, **data}
