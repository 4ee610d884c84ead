"""The notebooks run from their first to their last cell; what they show is made afresh, not compared."""

import ast
import json
import re
import tempfile
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib import pyplot as plt

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs/notebooks").glob("*.ipynb"))


def cells_of(notebook, kind):
    content = json.loads(notebook.read_text())
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == kind]


def run(cells):
    """Run cells of plain Python in one namespace, and show the last expression of each as Jupyter does."""
    names = {"__name__": "__main__"}
    for number, source in enumerate(cells, 1):
        tree = ast.parse(source, f"cell {number}")
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"cell {number}", "exec"), names)  # noqa: S102 - the notebook
        if last is not None:
            value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)  # noqa: S307
            getattr(value, "_repr_html_", value.__repr__)()
        plt.close("all")


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    mpl.use("Agg")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    run(cells_of(notebook, "code"))


def test_there_are_ten_cells_and_the_links_lead_somewhere():
    assert len(NOTEBOOKS) == 2
    assert len(cells_of(NOTEBOOKS[0], "code")) == 10
    for notebook in NOTEBOOKS:
        links = re.findall(r"\]\(([^)#]+)\)", " ".join(cells_of(notebook, "markdown")))
        assert links
        assert not [link for link in links if not (notebook.parent / link.replace("\n", "")).exists()]
