"""The [[log]] tables of data sets: `dataset = "ur10e"`, or a list, in place of robot and logs."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import PlainValidator, ValidationInfo

from sysid_bench.errors import UsageError
from sysid_bench.harness.suite.checks import check_input, list_of, list_values, value_of
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
    places = [_place(str(source)) for source in sources]
    tables = list_values(suite.get("log", ()))
    if not any(isinstance(one, Mapping) and DATASET in one for one in tables):
        raise UsageError(
            f"--set {DATASET}: no [[log]] of this suite names a data set; write one with "
            f'{DATASET} = "{sources[0] if sources else "NAME"}".'
        )
    return {**suite, "log": [one for table in tables for one in _with_places(table, places)]}


def _place(source: str) -> str:
    """A name of a set as it is, the place of one's own from the current folder as absolute."""
    found = find_dataset(source)
    return source if found.has_name else f"file:{found.file.resolve()}"


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
    return tuple(entry for written in value for entry in _entries(written, info))


def _entries(written: Any, info: ValidationInfo) -> Iterator[Any]:
    if not isinstance(written, Mapping) or DATASET not in written:
        yield written
        return
    for source in list_of(written[DATASET]):
        yield from value_of(partial(list, _of_set(written, str(source), info)))


def _of_set(
    written: Mapping[str, Any], source: str, info: ValidationInfo
) -> Iterator[dict[str, Any]]:
    """Yield the table of a data set; of a payload task one for each known payload."""
    _check_keys(written, source)
    described = find_dataset(source, check_input(info).folder).described
    place = f"{SCHEME}{source}"
    keys = {key: value for key, value in written.items() if key != DATASET}
    accept = list(dict.fromkeys([*list_values(keys.get("accept", ())), *described.accept]))
    common = {"name": NAME, **keys, "robot": place, "accept": accept}
    common |= _suitable(described, keys)
    if keys.get("task") != "payload":
        yield {**common, **_motions(place, described)}
        return
    if not described.payload:
        raise UsageError(f"the data set {source!r} has no recording with a known payload.")
    for pair in described.payload:
        motions = [f"{place}/{pair.empty}", f"{place}/{pair.loaded}"]
        yield {**common, "train": motions, "true_mass": pair.mass}


def _check_keys(written: Mapping[str, Any], source: str) -> None:
    """Raise UsageError for keys beside `dataset` that the data set gives."""
    both = [key for key in _WRITTEN if key in written]
    if both:
        raise UsageError(
            f"a data set gives {' and '.join(both)}; name the motions of one as a log, "
            f'train = ["{SCHEME}{source}/MOTION"], or drop the keys.'
        )


def _motions(place: str, described: DataSet) -> dict[str, Any]:
    """Training and test logs of a data set."""
    return {
        "train": [f"{place}/{motion}" for motion in described.train],
        "test": [_test(place, motion, described) for motion in described.test],
    }


def _test(place: str, motion: str, described: DataSet) -> dict[str, str]:
    """A test log, whose label says how it is related to the training."""
    return {"use": f"{place}/{motion}", "name": f"{motion} ({described.split})"}


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
