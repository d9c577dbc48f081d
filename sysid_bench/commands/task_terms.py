"""Queries to tasks: their joint terms, before anything is loaded, and verbs of their own."""

from collections.abc import Callable, Sequence
from typing import Any, cast

from sysid_bench.errors import UsageError, unknown_name
from sysid_bench.experiments.tasks.task import TaskDefinition, find_task, task_names_with_terms
from sysid_bench.models.manifest import TERM_ADVICE, TERMS, is_term
from sysid_bench.models.robot import RobotModel
from sysid_bench.plugin_names import known, resolve


def check_term_names(terms: Sequence[str] | None, features: bool = False) -> None:
    """Raise UsageError with the nearest name for an unknown joint term, and for a single text;
    `features`: those of recordings ("tanh") are terms as well."""
    more = tuple(known("term")) if features else ()
    # A text is a sequence of letters, each of which would be an unknown term.
    if isinstance(terms, str):
        raise UsageError(f"terms is a sequence of names, as [{terms!r}]; got the text {terms!r}.")
    for term in terms or ():
        if not (is_term(term) or term in more):
            advice = f"{TERM_ADVICE} Separate several by commas, or: none."
            raise unknown_name("joint term", term, (*TERMS, *more), advice)


def check_terms(task: str, terms: Sequence[str] | None) -> None:
    """Raise UsageError for an unknown joint term, and for terms that the task takes as known."""
    check_term_names(terms)
    if terms and not find_task(task).accepts_terms:
        raise UsageError(
            f"{', '.join(terms)} cannot be identified with the task {task!r}, which takes joint "
            "terms as known; leave --terms out, or use the task "
            f"{' or '.join(task_names_with_terms())}."
        )


def terms_of(
    definition: TaskDefinition, robot: RobotModel, terms: Sequence[str] | None
) -> tuple[str, ...]:
    """Return the joint terms to identify: the given ones, or those of the task for None."""
    return definition.default_terms(robot) if terms is None else tuple(terms)


def verb_of_task(task: TaskDefinition, verb: str) -> Callable[..., Any] | None:
    """Return what runs for a task in place of a verb; None: the verb itself."""
    target = task.commands.get(verb)
    return None if target is None else cast("Callable[..., Any]", resolve("task", target))
