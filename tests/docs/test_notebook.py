"""Execute the whole notebook."""

import os
import socket
from contextlib import suppress

import nbformat
import pytest
from nbclient import NotebookClient

from tests.support.processes import DEADLINE, ROOT


def port_of_nobody():
    """A free port below the ephemeral ones, which the notebook's kernel uses."""
    for port in range(20_000 + os.getpid() % 5000, 32_000):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


@pytest.mark.slow
def test_every_cell_of_the_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTEBOOK_PORT", str(port_of_nobody()))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(ROOT / "docs" / "tutorials" / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=DEADLINE, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in shown) == 2
    text = "".join(output.get("text", "") for output in shown)
    assert "steps after 40 candidates" in text
    nbformat.write(notebook, tmp_path / "executed.ipynb")
