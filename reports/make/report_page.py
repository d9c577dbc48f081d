"""Milliseconds until a report.html has its cells, and of its filters, in headless Chromium.

python -m reports.make.report_page REPORT.html [OPENINGS] opens the page and an empty one in
turn, each in a new browser, and prints the size, the median times (least to largest) until the
empty page, until the first rows, and until all cells can be filtered, the latter two also less
those of the empty page opened just before, and the least time of each filter with its layout.
"""

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
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
  const {ready, whole} = document.documentElement.dataset;
  fetch("/", {method: "POST", body: JSON.stringify({ready: +ready, whole: +whole, times})});
}
const wait = () => document.documentElement.dataset.whole ? measure() : setTimeout(wait, 5);
wait();
</script>
""".replace("REPEATS", str(REPEATS))


EMPTY = """<!doctype html><title>Empty</title><body></body><script>
fetch("/", {method: "POST", body: JSON.stringify({ready: performance.now()})});
</script>"""


class _Server(HTTPServer):
    """Answers with one page, and keeps what its script sends."""

    def __init__(self, page: bytes) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.page = page
        self.answer: dict[str, Any] = {}
        self.answered = threading.Event()

    def handle_error(self, *words: object) -> None:
        """Keep quiet about a browser that has ended."""


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
    """Open a page once; return what its script sends: ready, whole (ms), times (ms by filter)."""
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


def main(page: str, openings: str = "10") -> None:
    """Open the page several times and print the figures."""
    text = with_script(Path(page))
    pairs = [(measured(EMPTY)["ready"], measured(text)) for _ in range(int(openings))]
    answers = [answer for _, answer in pairs]
    times = {name: min(a["times"][name] for a in answers) for name in answers[0]["times"]}
    print(f"size   {Path(page).stat().st_size / 1e6:.2f} MB")
    print(f"empty  {_range([empty for empty, _ in pairs])}")
    for key, what in (("ready", "first rows"), ("whole", "all cells")):
        more = [answer[key] - empty for empty, answer in pairs]
        print(f"{key}  {_range([answer[key] for answer in answers])}, {_range(more)} more: {what}")
    for name, value in sorted(times.items(), key=lambda item: -item[1]):
        print(f"       {value:6.1f} ms  {name}")


def _range(times: Sequence[float]) -> str:
    return f"{statistics.median(times):.0f} ms ({min(times):.0f} to {max(times):.0f})"


if __name__ == "__main__":
    main(*sys.argv[1:])
