"""Fresh environments, to try what the docs tell to install."""

import subprocess
import sys
import venv
from collections.abc import Sequence
from pathlib import Path

import pytest


def environment_beside_us(folder: Path) -> tuple[Path, Path]:
    """A new environment that sees what is installed here, and this package: its python, its own packages' folder."""
    venv.create(folder, with_pip=True)
    here = [path for path in sys.path if path.endswith("site-packages")] + [str(Path(__file__).parents[2] / "src")]
    site = next((folder / "lib").glob("python*/site-packages"))
    (site / "here.pth").write_text("\n".join(here) + "\n")
    return folder / "bin" / "python", site


def install(python: Path, words: Sequence[str]) -> None:
    """`pip install` of these words; the test is skipped where no index answers."""
    done = subprocess.run([python, "-m", "pip", "install", "-q", *words], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the package index does not answer: {done.stderr.strip().splitlines()[-1]}")
