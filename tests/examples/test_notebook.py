"""examples/notebooks/first_steps.ipynb runs from top to bottom on a tiny demo folder, offline."""

from pathlib import Path

import nbformat
import pytest
from helpers.demo_folder import write_demo
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebooks" / "first_steps.ipynb"


@pytest.mark.filterwarnings("ignore:the base is the local folder")
def test_it_runs_and_shows_what_it_promises(tmp_path, monkeypatch):
    write_demo(tmp_path / "demo")
    monkeypatch.setenv("GIFT_PEFT_DEMO", str(tmp_path / "demo"))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    printed = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "the model predicts inverse_depth" in printed and "with the adapter" in printed
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 4


def test_it_is_stored_without_outputs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert all(
        not cell.outputs and cell.execution_count is None for cell in notebook.cells if cell.cell_type == "code"
    )
