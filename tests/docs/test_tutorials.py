"""Each page's own code and commands work as they stand, from an empty folder and on a small share of their numbers."""

import nbformat
import pytest
from nbclient import NotebookClient

from tests.docs.tutorial import WHOLE, run_page
from tests.support.processes import DEADLINE, ROOT

OBJECTIVE = "tutorials/own-objective.md", {}, "tune.png", ()
ENVIRONMENT = (
    "tutorials/own-environment.md",
    {
        "--generations 30 --evaluate-every 10": "--generations 2 --population 4 --evaluate-every 1"
        " --evaluation-episodes 2 --confirm-episodes 2",
        "--episodes 100": "--episodes 2",
    },
    "runs/drone/controller.npz runs/hidden/controller.npz drone-fitness.png drive.mp4",
    ("6 observations, 2 outputs", "gym:my_drone:Drone-v0", "hidden.json", "linear.json"),
)
WORLD = (
    "tutorials/own-world-model.md",
    {
        "--scale 0.5": "--scale 0.005 --jobs 1 --yes",
        "--episodes 1000": "--episodes 8",
        "--updates 1500": "--updates 8",
        "--survival": "--survival --episodes 4",
        "--generations 60": "--generations 2 --population 4 --episodes 2 --evaluate-every 1 --confirm-episodes 2",
        "--episodes 100": "--episodes 2",
    },
    "data/pixels.zip inspection/index.html runs/canyon/controller.npz drive.mp4",
    ("gym:my_world:Canyon-v0",),
)
QUALITY_DIVERSITY = (
    "how-to/quality-diversity.md",
    {"--population 48 --episodes 2 --generations 40": "--population 12 --episodes 1 --generations 3",
     "--episodes 20": "--episodes 2"},
    "swing-archive.png swing-csv/elites.npz",
    (" of 144 ",),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
@pytest.mark.parametrize(
    ("page", "shares", "made", "printed"),
    [OBJECTIVE, ENVIRONMENT, WORLD, QUALITY_DIVERSITY],
    ids=["objective", "environment", "world", "quality-diversity"],
)
def test_a_pages_commands_work_as_they_stand(tmp_path, page, shares, made, printed):
    found = run_page(page, shares, tmp_path)
    assert [text for text in printed if text not in found] == []
    for name in made.split():
        assert (tmp_path / name).stat().st_size > 100


@pytest.mark.slow
def test_every_cell_of_the_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(ROOT / "docs" / "tutorials" / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=DEADLINE, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert [sum(kind in data for data in shown) for kind in ("image/png", "text/html")] == [2, 2]
