"""Milliseconds until a report.html has its cells, and of its filters, in headless Chromium.

python tests/benchmarks/report_page.py REPORT.html [OPENINGS] prints the size, the time until the
table is filled (median, least and largest of the openings), that of a page without cells on the
same machine, and the least time of each filter with the layout of the page.
"""

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

REPEATS = 5
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--window-size=1400,900",
)  # fmt: skip

MEASURE = """
<script>
function timed(act) {
  const start = performance.now();
  act();
  document.body.offsetHeight;  // lays the page out
  return performance.now() - start;
}
const least = act => Math.min(...Array.from({length: REPEATS}, () => timed(act)));
const heads = () => [...document.querySelectorAll("#cells thead button")];
function choose(menu, index) {
  menu.selectedIndex = index;
  menu.onchange();
}
function measure() {
  const box = get("search"), times = {};
  for (const word of ["ur5", "ols", "ur10 wls", "no such cell", ""])
    times["search '" + word + "'"] = least(() => { box.value = word; box.oninput(); });
  for (const menu of document.querySelectorAll("#controls select")) {
    times["menu " + menu.name] = least(() => choose(menu, 1));
    choose(menu, 0);
  }
  for (const name of ["torque_error", "estimator"])
    times["sort by " + name] = least(() => heads().find(b => b.textContent === name).click());
  const ready = Number(document.documentElement.dataset.ready);
  fetch("/", {method: "POST", body: JSON.stringify({ready, times})});
}
const wait = () => document.documentElement.dataset.ready ? measure() : setTimeout(wait, 5);
wait();
</script>
""".replace("REPEATS", str(REPEATS))


EMPTY = """<!doctype html><title>Empty</title><body></body><script>
fetch("/", {method: "POST", body: JSON.stringify({ready: performance.now(), times: {}})});
</script>"""


class _Server(HTTPServer):
    """Answers with one page, and keeps what its script sends."""

    def __init__(self, page: bytes) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.page = page
        self.answer: dict[str, Any] = {}
        self.answered = threading.Event()


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.end_headers()
        self.wfile.write(self.server.page)

    def do_POST(self) -> None:
        self.server.answer = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(204)
        self.end_headers()
        self.server.answered.set()

    def log_message(self, *words: object) -> None:
        """Keep quiet."""


def with_script(page: Path) -> str:
    """Return the text of a report with the script that measures it."""
    text = page.read_text(encoding="utf-8").replace("</body>", MEASURE + "</body>")
    return text.replace("default-src 'none'", "default-src 'none'; connect-src 'self'", 1)


def measured(text: str, seconds: float = 120) -> dict[str, Any]:
    """Open a page once; return ready (ms) and times (ms by filter)."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("No Chromium is installed.")
    server = _Server(text.encode())
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [browser, *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={profile}", url]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            if not server.answered.wait(seconds):
                raise SystemExit(f"The page gave no answer within {seconds:g} s.")
        finally:
            process.terminate()
            process.wait()
            server.shutdown()
            server.server_close()
    return server.answer


def main(page: str, openings: str = "5") -> None:
    """Open the page several times and print the figures."""
    text, count = with_script(Path(page)), int(openings)
    answers = [measured(text) for _ in range(count)]
    times = {name: min(a["times"][name] for a in answers) for name in answers[0]["times"]}
    print(f"size   {Path(page).stat().st_size / 1e6:.2f} MB")
    print(f"ready  {_range(answers)}")
    print(f"empty  {_range([measured(EMPTY) for _ in range(count)])}")
    for name, value in sorted(times.items(), key=lambda item: -item[1]):
        print(f"       {value:6.1f} ms  {name}")


def _range(answers: Sequence[Mapping[str, Any]]) -> str:
    ready = [answer["ready"] for answer in answers]
    return f"{statistics.median(ready):.0f} ms ({min(ready):.0f} to {max(ready):.0f})"


if __name__ == "__main__":
    main(*sys.argv[1:])
