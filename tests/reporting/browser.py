"""A page as Chromium shows it; tests that need it skip where it is absent."""

import shutil
import subprocess
from pathlib import Path

import pytest

_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
    "--virtual-time-budget=20000",
)  # fmt: skip


def shown(page: Path, profile: Path, address: str = "", dark: bool = False) -> str:
    """Elements of a page after its script has run; the address is what follows #."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed")
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    url = f"{page.as_uri()}#{address}" if address else page.as_uri()
    command = [browser, *_FLAGS, scheme, f"--user-data-dir={profile}", "--dump-dom", url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout
