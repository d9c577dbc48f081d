"""The generated body regressor is what the derivation prints, byte for byte."""

import subprocess
import sys
from pathlib import Path

from sysid_bench.regressors import body
from sysid_bench.regressors.symbolic_regressor import source


def test_the_derivation_prints_the_module_that_is_there() -> None:
    assert source().encode() == Path(str(body.__file__)).read_bytes()


def test_the_command_in_the_docstring_prints_it() -> None:
    command = [sys.executable, "-m", "sysid_bench.regressors.symbolic_regressor"]
    printed = subprocess.run(command, capture_output=True, check=True).stdout
    assert printed == Path(str(body.__file__)).read_bytes()
