"""What both kernels owe is asked of both."""

from collections.abc import Iterator

import pytest

from sysid_bench.instruction_sets import LEVELS, VARIABLE
from sysid_bench.regressors.kernel_c import KernelSelection, select_kernel


@pytest.fixture
def choose(monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """A function that makes a kernel, by its name in the variable, that of this process."""

    def to(name: str) -> KernelSelection:
        monkeypatch.setenv(VARIABLE, name)
        select_kernel.cache_clear()
        return select_kernel()

    yield to
    monkeypatch.undo()
    select_kernel.cache_clear()


@pytest.fixture(params=["numpy", *LEVELS])
def kernel_name(request: pytest.FixtureRequest, choose: object) -> str:
    """Every kernel that this machine runs, in turn the one of this process."""
    name: str = request.param
    choice = choose(name)  # type: ignore[operator]
    if name != "numpy" and choice.library is None:
        pytest.skip(choice.reason)
    return name
