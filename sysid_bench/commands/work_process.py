"""Work on several data sets, in processes of its own."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import TypeVar

Found = TypeVar("Found")


def run_work(work: Mapping[str, Callable[[], Found]], jobs: int) -> Iterator[tuple[str, Found]]:
    """Yield the name and the result of each piece of work as it is done, in `jobs` processes; with
    one job in this process and in order."""
    if jobs == 1:
        yield from ((name, one()) for name, one in work.items())
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        waiting = {pool.submit(one): name for name, one in work.items()}
        yield from ((waiting[done], done.result()) for done in as_completed(waiting))
