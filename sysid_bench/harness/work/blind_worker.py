"""Process of one third-party method, `python -m sysid_bench.harness.work.blind_worker`.

In: a line {folder, hidden, memory, isolation, sealed, path, estimator}, then for each call a line
{call, bytes}, the data of the method (`method_data`) and, once it has answered {ready}, an empty
line. Out, as JSON lines: {isolation}; {calls, frame_dependent} of the method; for each call
{ready}, then {estimate, modules} or {error: [status, reason, traceback], modules}. It started fresh
and never held the truth.
"""

import contextlib
import io
import json
import os
import signal
import sys
import threading
import traceback
from importlib import import_module
from typing import IO, Any

_process = 0


def main() -> None:
    """Serve the calls of one method until the input ends."""
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # Prints of methods go to the log, and input() reads nothing.
    null_device = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null_device, 0)
    os.dup2(2, 1)
    head = json.loads(requests.readline())

    # Before the libraries are loaded, which takes memory, and threads, which no fork has.
    from sysid_bench.harness.work.confinement import confine
    from sysid_bench.words import FRAME_DEPENDENT, PROCESS

    isolation = confine(head["folder"], head["hidden"], head["isolation"], private=True)
    if sys.platform != "linux":
        requests = _ending_with_parent(requests)
    global _process
    _process = os.getpid()
    _answer(answers, {"isolation": isolation})
    if head["sealed"] and isolation == PROCESS:
        return  # before any code of the method, which could read the seed
    if head["memory"] is not None:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (head["memory"],) * 2)
    sys.path[:] = list(dict.fromkeys([*head["path"], *sys.path]))
    try:
        # What data are made of is loaded as a part of the start, not of its cell: 0.4 s.
        for name in ("experiments.blind_data", "regressors.block_qr", "identification.identify"):
            import_module(f"sysid_bench.{name}")
        from sysid_bench.plugin_names import build

        method = build("estimator", head["estimator"])
        calls = [name for name in ("solve", "fit") if hasattr(method, name)]
        declared = getattr(method, FRAME_DEPENDENT, "")
        declared = declared if isinstance(declared, (bool, str)) else ""
    except BaseException as error:  # sys.exit() of a plug-in as well
        _answer(answers, {"error": _error(error)})
        return
    _answer(answers, {"calls": calls, FRAME_DEPENDENT: declared})
    while line := requests.readline():
        _serve(json.loads(line), method, requests, answers)


def _ending_with_parent(requests: io.BufferedReader) -> io.BufferedReader:
    """The same requests; at their end, which the end of the parent is as well, this process ends
    with its group, also while the method runs. Linux does so by itself (kill_with)."""
    read_end, write_end = os.pipe()

    def pass_on() -> None:
        while data := requests.read1(1 << 16):
            while data:
                data = data[os.write(write_end, data) :]
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)
        os._exit(0)

    threading.Thread(target=pass_on, daemon=True).start()
    return os.fdopen(read_end, "rb")


def _serve(request: dict[str, Any], method: Any, requests: IO[bytes], answers: IO[bytes]) -> None:
    from types import SimpleNamespace

    from sysid_bench.canonical_json import plain
    from sysid_bench.experiments.blind_data import read_method_data
    from sysid_bench.identification.identify import identify
    from sysid_bench.plugin_names import module_files

    problem, experiment = read_method_data(requests.read(request["bytes"]))
    _answer(answers, {"ready": True})
    requests.readline()
    name = request["call"]
    try:
        call = SimpleNamespace(**{name: getattr(method, name)})
        estimate = identify(call, problem, experiment)
        stats = {k: x for k, x in estimate.stats.items() if k not in ("seconds", "seconds_cpu")}
        found = json.dumps({"estimate": plain(vars(estimate) | {"stats": stats})})
    except BaseException as error:
        found = json.dumps({"error": _error(error)})
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    _answer(answers, json.loads(found) | {"modules": module_files()})


def _answer(answers: IO[bytes], message: dict[str, Any]) -> None:
    if os.getpid() != _process:  # a fork that came back from the method
        os._exit(1)
    answers.write(json.dumps(message).encode() + b"\n")
    answers.flush()


def _error(error: BaseException) -> tuple[str, str, str]:
    from sysid_bench.errors import LONGEST_TEXT, SysidBenchError, reason_of, status_of

    lines = [line[:LONGEST_TEXT] for line in traceback.format_exception(error)]
    text = "" if isinstance(error, SysidBenchError) else "".join(lines)
    return status_of(error), reason_of(error), text


if __name__ == "__main__":
    main()
