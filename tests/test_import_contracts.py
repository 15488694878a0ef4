"""The import contracts of pyproject.toml hold, and each of them notices when it is broken."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    command = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    return subprocess.run(
        [sys.executable, "-c", command, "--no-cache", "--config", str(root / "pyproject.toml")],
        cwd=root,
        # The copy must be found before the installed package.
        env={**os.environ, "PYTHONPATH": str(root / "src"), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    ignored = shutil.ignore_patterns("__pycache__", "assets", "*.egg-info")
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_contracts_hold(copy: Path):
    result = lint_imports(copy)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("errors", "import dyngrasp.models", "Imports point down, siblings never meet"),
        ("control/intruder", "import dyngrasp.simulation", "Imports point down, siblings never meet"),
        ("unplaced", "", "Imports point down, siblings never meet"),
        ("planning/problem", "import dyngrasp.planning.collocation", "Inside planning"),
        ("planning/unplaced", "", "Inside planning"),
        ("control/intruder", "import mujoco.viewer", "MuJoCo only in simulation"),
        ("control/intruder", "from casadi import SX", "CasADi only in models and planning"),
        ("experiments/intruder", "import matplotlib.pyplot", "Plotting only in report"),
        ("control/intruder", "import cv2", "OpenCV only in perception and simulation"),
    ],
)
def test_contract_notices(copy: Path, module: str, line: str, contract: str):
    path = copy / "src" / "dyngrasp" / f"{module}.py"
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    path.write_text(f"{before}\n{line}\n", encoding="utf-8")
    result = lint_imports(copy)
    assert result.returncode == 1
    broken = [text for text in result.stdout.splitlines() if " BROKEN" in text]
    assert [text for text in broken if text.startswith(contract)] == broken
    assert broken
