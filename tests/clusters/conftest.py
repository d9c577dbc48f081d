"""Workers import the task functions of the tests of the harness by name."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "harness"))
