"""Results of checks in the forms that continuous integration reads: JUnit XML and annotations."""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from sysid_bench.errors import first_names


@dataclass(frozen=True)
class Check:
    """One check by its name; `failures`: a sentence for each reason, none where it passed."""

    name: str
    failures: tuple[str, ...] = ()


def to_junit(name: str, checks: Sequence[Check]) -> str:
    """JUnit XML: a test suite `name` with a test case for each check."""
    failed = sum(bool(check.failures) for check in checks)
    counts = {"tests": str(len(checks)), "failures": str(failed), "errors": "0", "skipped": "0"}
    suite = ElementTree.Element("testsuite", {"name": _xml_text(name), **counts})
    for check in checks:
        place = {"classname": _xml_text(name), "name": _xml_text(check.name)}
        case = ElementTree.SubElement(suite, "testcase", place)
        if check.failures:
            message = _xml_text(check.failures[0])
            failure = ElementTree.SubElement(case, "failure", message=message)
            failure.text = _xml_text("\n".join(check.failures))
    suites = ElementTree.Element("testsuites")
    suites.append(suite)
    ElementTree.indent(suites)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(
        suites, encoding="unicode"
    )


def to_annotations(title: str, file: str, checks: Sequence[Check]) -> str:
    """Workflow commands, "::error file=...,title=...::...", a line for each failed check."""
    place = f"file={_property(file)},title={_property(title)}"
    return "".join(
        f"::error {place}::{_message(f'{check.name}: {first_names(check.failures)}')}\n"
        for check in checks
        if check.failures
    )


def _xml_text(text: str) -> str:
    """`text` without characters that XML 1.0 cannot hold."""
    return "".join(c if c in "\t\n" or c.isprintable() else "?" for c in text)


def _message(text: str) -> str:
    """Text of a workflow command: line ends and percent signs are escaped."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    # Properties of a workflow command end at a comma, and the command at "::".
    return _message(text).replace(":", "%3A").replace(",", "%2C")
